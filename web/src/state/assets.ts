/** The assets of the scene: which one is chosen, and where a drag of its handles takes it. */

import { computed, signal } from "@preact/signals";

import type { AssetSet, SceneAssetInfo } from "../messages";
import { add, dot, scale, sub, type Vec3 } from "../view/camera";
import { NewestOnly } from "./newest-only";
import { state } from "./store";
import { during, withUnderWay } from "./under-way";
import { run } from "../editor/editor";

export const selectedAsset = signal<string | null>(null);

const nameIn = (asset: string): string => `asset ${asset}`;

/** Those of the scene, with what is under way. */
export const assets = computed<SceneAssetInfo[]>(() =>
  (state.value?.assets ?? []).map((one) => withUnderWay(nameIn(one.id), one)),
);

/** The chosen asset; null: none is. */
export const chosenAsset = computed(() => assets.value.find((one) => one.id === selectedAsset.value) ?? null);

/** Of several assets, the one that batches are made of: the chosen one, else the first. Null: there is one. */
export const batchAsset = computed(() => (assets.value.length > 1 ? (chosenAsset.value ?? assets.value[0]) : null));

/** The name of an asset, where there are several; "" where there is one. */
export const nameOfAsset = (id: string): string =>
  assets.value.length > 1 ? (assets.value.find((one) => one.id === id)?.name ?? "") : "";

/** Where an asset stands. */
export type Stand = Pick<SceneAssetInfo, "move" | "turn" | "scale">;
type Rows = [Vec3, Vec3, Vec3];
const RADIANS = Math.PI / 180;

/** Change its name, or whether it is shown; `what` says so where it takes a while. */
export const setAsset = (asset: string, fields: Pick<AssetSet, "name" | "visible">, what: string) =>
  during(
    nameIn(asset),
    (one: SceneAssetInfo) => ({ ...one, name: fields.name ?? one.name, visible: fields.visible ?? one.visible }),
    run("scene.set", { asset, ...fields }, what),
  );

/** A change that is dragged: one command at a time, the latest value last, one step of the history. */
export function draggedAsset(asset: string): (fields: Partial<Stand>) => Promise<void> {
  const gesture = `stand ${Math.random().toString(36).slice(2)}`;
  let fields: Partial<Stand> = {};
  const changes = new NewestOnly<Partial<Stand>>((newest) => run("scene.set", { asset, ...newest, gesture }, ""));
  return (part) => {
    fields = { ...fields, ...part };
    const set = (one: SceneAssetInfo) => standing(one, part);
    return during(nameIn(asset), set, changes.add(fields));
  };
}

/** With another stand. Where its centre comes to be the server says: a turn leaves it where it is. */
const standing = (one: SceneAssetInfo, part: Partial<Stand>): SceneAssetInfo => ({
  ...one,
  ...part,
  moved: one.moved.map((old, k) => old + (part.move ? part.move[k] - one.move[k] : 0)),
});

/** The rotation about x, then y, then z. */
export function matrixOf(turn: readonly number[]): Rows {
  const [a, b, c] = turn.map((degrees) => degrees * RADIANS);
  const [sa, ca, sb, cb, sc, cc] = [a, b, c].flatMap((angle) => [Math.sin(angle), Math.cos(angle)]);
  return [
    [cc * cb, cc * sb * sa - sc * ca, cc * sb * ca + sc * sa],
    [sc * cb, sc * sb * sa + cc * ca, sc * sb * ca - cc * sa],
    [-sb, cb * sa, cb * ca],
  ];
}

/** The inverse of matrixOf; the angle about y is within 90 degrees. */
export function turnOf(m: Rows): Vec3 {
  const b = Math.asin(Math.max(-1, Math.min(1, -m[2][0])));
  const locked = Math.abs(m[2][0]) > 1 - 1e-9;
  const a = locked ? Math.atan2(-m[1][2], m[1][1]) : Math.atan2(m[2][1], m[2][2]);
  const c = locked ? 0 : Math.atan2(m[1][0], m[0][0]);
  return [a / RADIANS, b / RADIANS, c / RADIANS];
}

const times = (m: Rows, p: Vec3): Vec3 => [dot(m[0], p), dot(m[1], p), dot(m[2], p)];

/** A stand after a turn about an axis of the scene through a point. */
export function turned(stand: Stand, axis: 0 | 1 | 2, degrees: number, center: Vec3): Stand {
  const about: Vec3 = [0, 0, 0];
  about[axis] = degrees;
  const step = matrixOf(about);
  const now = matrixOf(stand.turn);
  const columns = [0, 1, 2].map((k) => times(step, [now[0][k], now[1][k], now[2][k]]));
  const rows = [0, 1, 2].map((k) => [columns[0][k], columns[1][k], columns[2][k]]) as Rows;
  const move = add(center, times(step, sub(stand.move as Vec3, center)));
  return { move, turn: turnOf(rows), scale: stand.scale };
}

/** A stand after growing about a point. */
export function grown(stand: Stand, factor: number, center: Vec3): Stand {
  const size = Math.max(1e-6, Math.min(1e6, stand.scale * factor));
  const move = add(center, scale(sub(stand.move as Vec3, center), size / stand.scale));
  return { move, turn: stand.turn, scale: size };
}

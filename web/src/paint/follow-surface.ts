/** Asks the server for the surface of the present view while a tool needs it. */

import { effect } from "@preact/signals";

import { editor } from "../editor/editor";
import { camera, state } from "../state/store";
import type { CameraJson } from "../view/camera";
import { SurfaceView } from "./surface-blocks";
import { isSameView, viewSurface } from "./view-surface";

/** The camera rests so long before its surface is asked for. */
const REST_MS = 120;

/** Start following the view. `needed`: whether the tool in hand needs the surface; read inside of an effect. */
export function followSurface(needed: () => boolean): void {
  let timer: ReturnType<typeof setTimeout>;
  let requestedKey = "";
  const ask = async (view: CameraJson, key: string): Promise<void> => {
    requestedKey = key;
    try {
      const { block, columns, rows, data } = await editor.link.do("view.surface", { camera: view });
      if (!camera.value || !isSameView(camera.value, view)) return;
      const bytes = Uint8Array.from(atob(data), (letter) => letter.charCodeAt(0));
      viewSurface.value = new SurfaceView(view, block, columns, rows, new Float32Array(bytes.buffer));
    } catch {
      requestedKey = ""; // the tools go on without it; a lost connection is said elsewhere
    }
  };
  effect(() => {
    const [view, now, wanted] = [camera.value, state.value, needed()];
    clearTimeout(timer);
    if (!view || !now || !wanted) return;
    // paint changes what is seen, but hardly where the surface is: layers that hide or fill something do
    const hidden = now.layers
      .filter((layer) => ["hide", "fill"].includes(layer.kind))
      .map((layer) => `${layer.id}${layer.visible}`);
    const key = JSON.stringify([now.session, view, hidden]);
    if (key !== requestedKey) timer = setTimeout(() => void ask(view, key), REST_MS);
  });
}

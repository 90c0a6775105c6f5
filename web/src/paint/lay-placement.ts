/** From a placed text or picture to a layer, or back to the layer that it was. */

import { effect } from "@preact/signals";

import { editor, report, run } from "../editor/editor";
import type { Placed } from "../messages";
import { sendBlob } from "../net/blobs";
import {
  brush,
  camera,
  color,
  limits,
  method,
  paintMode,
  saving,
  selectedLayer,
  state,
  status,
  swapped,
  text,
  toast,
} from "../state/store";
import { waitsForAnswer } from "../state/waiting";
import { drafts } from "../state/draft-steps";
import { blend, type Rgb } from "./colors";
import { angleOf, type Anchor } from "./decal";
import { drawPlacement } from "./decal-preview";
import { limitsToSend } from "./limits";
import { editedLayer, fromAnchor, laying, level, placedSteps, placement, standOf, type Placement } from "./placement";
import type { Stroke } from "./stroke";
import { surfaceArrived, surfaceOf, wrapping } from "./view-surface";

/** The layer that is being changed, where its project is shown; of one that was left the server shows it itself. */
function editedHere(): typeof editedLayer.value {
  const edited = editedLayer.value;
  return edited && edited.project === state.value?.project.id ? edited : null;
}

/** Hide it again once the connection is back, without which the server has shown it. */
function hideAgain(): void {
  let before: typeof state.value | undefined;
  effect(() => {
    const [now, open] = [state.value, status.value === "open"];
    if (!open) before = now;
    if (!open || before === undefined || before === now || swapped.value) return;
    before = undefined;
    const edited = editedHere();
    const shown = now?.layers.some(({ id, visible }) => id === edited?.layer && visible);
    if (edited && shown && placement.peek())
      void run("layer.set", { layer: edited.layer, visible: false, gesture: edited.gesture }, edited.name);
  });
}
hideAgain();

/** Take it away; a layer that was being changed is as it was. */
export async function discardPlacement(): Promise<void> {
  if (laying.value) return;
  placement.value = null;
  const edited = editedHere();
  editedLayer.value = null;
  if (edited) await run("layer.set", { layer: edited.layer, visible: true, gesture: edited.gesture }, edited.name);
}

/** Take it away for good: a layer that was being changed goes, too. */
export async function deletePlacement(): Promise<void> {
  if (laying.value) return;
  const edited = editedHere();
  await discardPlacement();
  if (edited) await run("layer.delete", { layer: edited.layer }, "Deleting");
}

/** Take back its latest drag; where it was not dragged it goes. */
function undoPlacing(): void {
  const p = placement.value;
  const stand = p && placedSteps.back(standOf(p));
  if (p && stand) placement.value = { ...p, ...stand };
  else void discardPlacement();
}

/** What `undoPlacing` took back comes again. */
function redoPlacing(): void {
  const p = placement.value;
  const stand = p && placedSteps.again(standOf(p));
  if (p && stand) placement.value = { ...p, ...stand };
}

const isPlacing = (): boolean => placement.value !== null && !laying.value;
drafts.push({
  canBack: isPlacing,
  back: undoPlacing,
  canAgain: () => isPlacing() && placedSteps.canAgain,
  again: redoPlacing,
});

/** What is kept of it with its layer. */
async function placedInfo(p: Placement): Promise<Placed> {
  const { x, y, scale, angle } = p;
  const surface = { unit: p.anchor?.unit ?? null, wrap: wrapping.value.limit, view: p.anchor?.camera ?? null };
  const common = { x, y, scale, angle, opacity: brush.value.opacity, mode: paintMode.value, ...surface };
  const written = { ...text.value, color: color.value, image: null };
  if (p.kind === "text") return { kind: "text", ...common, ...written };
  const canvas = new OffscreenCanvas(p.image.width, p.image.height);
  canvas.getContext("2d")!.drawImage(p.image, 0, 0);
  const image = await sendBlob(await canvas.convertToBlob({ type: "image/png" }), `${p.name}.png`);
  return { kind: "sticker", ...common, ...written, text: "", image };
}

/** Have it laid on the surface; it is shown as it was placed until that is done. */
async function lay(p: Placement, anchor: Anchor, placed: Placed, name: string): Promise<void> {
  const { x, y, camera: seen } = anchor; // where it was put, which the present view may not show
  const [placedNow, edited] = [placement.value, editedLayer.value];
  try {
    const canvas = new OffscreenCanvas(p.image.width, p.image.height);
    const context = canvas.getContext("2d")!;
    context.globalAlpha = brush.value.opacity;
    context.drawImage(p.image, 0, 0);
    const picture = await sendBlob(await canvas.convertToBlob({ type: "image/png" }), `${p.kind}.png`);
    const answer = await run(
      "decal.lay",
      {
        camera: seen,
        x,
        y,
        picture,
        width: anchor.unit * p.image.width,
        angle: (-angleOf(seen, anchor, level()) * 180) / Math.PI,
        wrap: wrapping.value.limit,
        placed,
        ...(edited ? { replaces: edited.layer, gesture: edited.gesture } : {}),
        name,
        method: method.value,
        limits: limitsToSend(limits.value),
      },
      name,
    );
    if (!answer) return; // it stays where it is, to be moved; the reason was said
    if (placement.value === placedNow) placement.value = null; // else another one was chosen meanwhile
    if (editedLayer.value === edited) editedLayer.value = null;
    selectedLayer.value = answer.layer.id;
    if (answer.note) toast("warning", answer.note);
  } catch (error) {
    report(error, name);
  }
}

/** Make it a layer, or the layer that it was again. */
export async function commitPlacement(): Promise<void> {
  if (!placement.value || laying.value) return;
  const [problem, hint] = waitsForAnswer("Apply") ?? [];
  if (problem) return toast("info", problem, hint);
  // From here to the answer: a second Enter makes no second layer, and nothing says "Saved".
  laying.value = true;
  saving.value++;
  try {
    await commit();
  } finally {
    laying.value = false;
    saving.value--;
  }
}

async function commit(): Promise<void> {
  if (wrapping.value.on && placement.value && !placement.value.flat && !placement.value.anchor)
    if (!surfaceOf(camera.value)) {
      await surfaceArrived(camera.value!); // applied before the surface is known, it is to lie there all the same
      laying.value = false; // now it goes there
      laying.value = true;
    }
  const current = placement.value;
  if (!current) return;
  const p = current.anchor ? fromAnchor(current, current.anchor, current.anchor.camera) : current;
  const edited = editedLayer.value;
  const placed = await placedInfo(p).catch((error) => void report(error));
  if (!placed) return;
  const target = edited && !edited.strokes ? { replaces: edited.layer, gesture: edited.gesture, placed } : { placed };
  const title = p.kind === "text" ? `Text: ${text.value.text.slice(0, 40)}` : p.name;
  if (p.anchor) return lay(p, p.anchor, placed, title);
  const stroke = editor.strokes.begin("paint", title, { target });
  if (!stroke) return;
  placement.value = null;
  editedLayer.value = null;
  const { width, height } = stroke.mask;
  const context = new OffscreenCanvas(width, height).getContext("2d")!;
  drawPlacement(context, p);
  const { data } = context.getImageData(0, 0, width, height);
  for (let k = 0; k < width * height; k++) stroke.mask.data[k] = data[k * 4 + 3] / 255;
  const mode = paintMode.value;
  stroke.setSource((x, y, out) => {
    const at = (y * width + x) * 4;
    const pixel: Rgb = [data[at], data[at + 1], data[at + 2]];
    const base = mode === "normal" ? null : stroke.base;
    [out[0], out[1], out[2]] = base ? blend(mode, pixel, [base.data[at], base.data[at + 1], base.data[at + 2]]) : pixel;
  });
  stroke.touch({ x: 0, y: 0, width, height });
  void endStroke(stroke, edited).catch(report); // the next one can be placed meanwhile
}

async function endStroke(stroke: Stroke, edited: typeof editedLayer.value): Promise<void> {
  await editor.strokes.end(stroke);
  if (edited?.strokes) await run("layer.delete", { layer: edited.layer }, edited.name);
}

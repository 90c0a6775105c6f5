/** Entry: make the view, mount the interface, connect. */

import { render } from "preact";

import "./style/base.css";
import "./style/controls.css";
import "./style/panels.css";
import "./style/high-contrast.css";
import { limits } from "./net/connection";
import { parseFrame } from "./net/frames";
import { followAside } from "./state/side-view";
import { camera, graphicsLost, pendingStrokes, pose, state, status } from "./state/store";
import { cursorFrame } from "./paint/brush";
import { meanRadius } from "./paint/dabs";
import { followDecal } from "./paint/decal-preview";
import { followSurface } from "./paint/follow-surface";
import { handles, placement } from "./paint/placement";
import { surfaceOf } from "./paint/view-surface";
import { inHand } from "./tools";
import { penInput } from "./tools/pen-input";
import { go } from "./editor/camera-moves";
import { editor } from "./editor/editor";
import { App } from "./ui/app";
import { listen } from "./ui/keys";

const root = document.getElementById("app")!;
const canvas = document.createElement("canvas");
try {
  editor.start(canvas);
  render(<App canvas={canvas} />, root);
  listen();
  followSurface(() => inHand().needsSurface?.() ?? false);
  followDecal();
  followAside();
  graphicsLost.subscribe((lost) => lost && penInput.finish()); // before the page is loaded again
  window.addEventListener("beforeunload", (event) => {
    if (pendingStrokes.value > 0 && status.value !== "open" && !editor.strokes.allKept) event.preventDefault();
  });
  const brushRadius = (x: number, y: number) =>
    meanRadius(cursorFrame(x * camera.value!.width, y * camera.value!.height));
  const surface = (x = 0.5, y = 0.5) =>
    surfaceOf(camera.value)?.at(x * camera.value!.width, y * camera.value!.height) ?? null;
  const tools = { brushRadius, surface, placement, handles };
  const { viewer, link } = editor;
  const studio = { viewer, link, go, pose, camera, state, parseFrame, limits, ...tools };
  Object.assign(window, { studio }); // for the console and for tests
} catch (error) {
  console.error(error);
  root.textContent = `The studio needs WebGL 2 with float textures, which this browser does not offer (${error instanceof Error ? error.message : error}).`;
}

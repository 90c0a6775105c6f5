/** Entry: make the view, mount the interface, connect. */

import { render } from "preact";

import "./style/base.css";
import "./style/controls.css";
import "./style/panels.css";
import { limits } from "./net/connection";
import { parseFrame } from "./net/frames";
import { followAside } from "./state/side-view";
import { camera, pendingStrokes, pose, state, status } from "./state/store";
import { cursorFrame } from "./paint/brush";
import { meanRadius } from "./paint/dabs";
import { handles, placement } from "./paint/placement";
import { followDecal } from "./paint/placement";
import { followSurface, surfaceOf } from "./paint/view-surface";
import { go, link, start, viewer } from "./state/studio";
import { App } from "./ui/app";
import { listen } from "./ui/keys";

const root = document.getElementById("app")!;
const canvas = document.createElement("canvas");
try {
  start(canvas);
  render(<App canvas={canvas} />, root);
  listen();
  followSurface();
  followDecal();
  followAside();
  window.addEventListener("beforeunload", (event) => {
    if (pendingStrokes.value > 0 && status.value !== "open") event.preventDefault(); // they would be lost
  });
  const brushRadius = (x: number, y: number) =>
    meanRadius(cursorFrame(x * camera.value!.width, y * camera.value!.height));
  const surface = (x = 0.5, y = 0.5) =>
    surfaceOf(camera.value)?.at(x * camera.value!.width, y * camera.value!.height) ?? null;
  const tools = { brushRadius, surface, placement, handles };
  const studio = { viewer, link, go, pose, camera, state, parseFrame, limits, ...tools };
  Object.assign(window, { studio }); // for the console and for tests
} catch (error) {
  console.error(error);
  root.textContent = `The studio needs WebGL 2 with float textures, which this browser does not offer (${error instanceof Error ? error.message : error}).`;
}

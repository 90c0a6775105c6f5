/**
 * Still pictures of the view from the server: true colour, the original for the before/after line, coverage, what the
 * limits leave out, and how sure a layer that spreads is.
 */

import { signal } from "@preact/signals";
import { useEffect } from "preact/hooks";

import { blobUrl } from "../net/blobs";
import { limitsToSend } from "../paint/limits";
import { run } from "../editor/editor";
import { camera, compareAt, limits, moving, selectedLayer, spreading, state, view } from "../state/store";
import { inHand } from "../tools";
import type { CameraJson } from "../view/camera";

type Kind = "true" | "before" | "coverage" | "limits" | "confidence";
type Profile = "inria" | "playcanvas";
interface Still {
  url: string;
  camera: CameraJson;
  version: number;
  profile: Profile;
  /** What else it depends on. */
  settings: string;
}
const pictures: Record<Kind, ReturnType<typeof signal<Still | null>>> = {
  true: signal(null),
  before: signal(null),
  coverage: signal(null),
  limits: signal(null),
  confidence: signal(null),
};
/** What the last coverage said, and where to look next. */
export const covered = signal<{ seen: number; predicted: number; next: CameraJson | null } | null>(null);

async function ask(kind: Kind, at: CameraJson, profile: Profile): Promise<string | null> {
  if (kind === "coverage") {
    const answer = await run("coverage", { camera: at }, "Coverage");
    if (answer)
      covered.value = { seen: answer.seen, predicted: answer.predicted, next: answer.next_view as CameraJson | null };
    return answer && blobUrl(answer.picture);
  }
  if (kind === "limits") {
    const answer = await run("paint.limits", { camera: at, limits: limitsToSend(limits.value) });
    return answer && blobUrl(answer.picture);
  }
  if (kind === "confidence") {
    const layer = spreadLayer();
    const answer = layer && (await run("spread.show", { camera: at, layer: layer.id }, "Confidence"));
    return answer && blobUrl(answer.picture);
  }
  const which = kind === "before" ? "original" : "now";
  const answer = await run("view.render", { camera: at, which, profile }, "Rendering");
  return answer && blobUrl(answer.picture);
}

/** The chosen layer, if it is one that spreads and is visible. */
function spreadLayer() {
  const layer = state.value?.layers.find((one) => one.id === selectedLayer.value);
  return layer && layer.mode === "spread" && layer.visible && layer.opacity > 0 && !layer.problem ? layer : null;
}

/** The picture of the present view if it is enabled, there, and up to date; asks for it when the camera rests. */
function usePicture(kind: Kind, enabled: boolean, settings = ""): string | null {
  const now = camera.value;
  const version = state.value?.version ?? 0;
  const still = !moving.value;
  // Beside the live view, which draws as 3DGS does, the original is drawn so too.
  const profile = view.value.trueColor ? view.value.profile : "inria";
  const current = pictures[kind].value;
  const fresh =
    current !== null &&
    current !== undefined &&
    current.camera === now &&
    current.profile === profile &&
    current.settings === settings &&
    (kind === "before" || current.version === version);
  useEffect(() => {
    if (!enabled || !still || fresh || !now) return;
    void ask(kind, now, profile).then((url) => {
      if (url) pictures[kind].value = { url, camera: now, version, profile, settings };
    });
  }, [enabled, still, fresh, now, version, kind, profile, settings]);
  return enabled && current && current.camera === now && current.profile === profile ? current.url : null;
}

export function Overlays() {
  const { trueColor, compare, coverage } = view.value;
  const truth = usePicture("true", trueColor);
  const before = usePicture("before", compare);
  const seen = usePicture("coverage", coverage);
  const { angle, depthEdge, show } = limits.value;
  const leftOut = usePicture("limits", show && inHand().limited === true, `${angle} ${depthEdge}`);
  const spread = spreadLayer();
  const confidence = usePicture("confidence", spreading.value.show && spread !== null, spread?.id ?? "");
  const at = compareAt.value;
  return (
    <>
      {truth && <img class="still" src={truth} alt="" data-still="true" />}
      {before && (
        <img
          class="still"
          src={before}
          alt=""
          data-still="before"
          style={{ clipPath: `inset(0 ${(1 - at) * 100}% 0 0)` }}
        />
      )}
      {seen && <img class="still" src={seen} alt="" data-still="coverage" />}
      {seen && (
        <p class="legend">
          <i class="seen" /> seen by an edited view <i class="predicted" /> predicted <i /> as in the original
        </p>
      )}
      {confidence && <img class="still" src={confidence} alt="" data-still="confidence" />}
      {confidence && (
        <p class="legend">
          <i class="seen" /> of the painted material <i class="predicted" /> not sure enough
        </p>
      )}
      {leftOut && (
        <div class="left-out" data-still="limits" style={{ maskImage: `url(${leftOut})`, maskSize: "100% 100%" }} />
      )}
      {compare && (
        <div class="compare" style={{ left: `${at * 100}%` }}>
          <span class="before-label">{before ? "before" : "before: loading"}</span>
          <span class="after-label">after</span>
        </div>
      )}
      {compare && (
        <input
          class="compare-slider"
          type="range"
          min={0}
          max={1}
          step={0.001}
          value={at}
          aria-label="Before and after"
          onInput={(event) => (compareAt.value = Number(event.currentTarget.value))}
        />
      )}
    </>
  );
}

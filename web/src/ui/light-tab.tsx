/** The light panel on the chosen light layer, or on one that is to be made. */

import { signal } from "@preact/signals";
import { useEffect } from "preact/hooks";

import { run } from "../editor/editor";
import {
  anotherLight,
  beginGesture,
  changeLights,
  hold,
  letGo,
  lightLayer,
  shownLights,
  toggleLight,
} from "../lights/light-layers";
import { azimuthOf } from "../lights/sun-ball";
import { blobUrl } from "../net/blobs";
import { selectedCount } from "../paint/selected";
import { camera, readOnly, state } from "../state/store";
import { LightPanel, type Sky } from "./light-panel";
import { Button } from "./parts";

/** null: not asked for yet. */
const skies = signal<Sky[] | null>(null);
const title = (name: string) => name[0].toUpperCase() + name.slice(1);

const isColor = (target: EventTarget | null) => target instanceof HTMLInputElement && target.type === "color";
/** Of the window: wherever the pointer is let go. */
const ENDS = ["pointerup", "pointercancel", "keyup", "blur"] as const;

export function LightTab() {
  useEffect(() => {
    const end = () => void letGo();
    for (const name of ENDS) addEventListener(name, end);
    return () => {
      for (const name of ENDS) removeEventListener(name, end);
      end();
    };
  }, []);
  useEffect(() => {
    if (skies.value === null)
      void run("light.skies", {}).then((answer) => {
        if (answer)
          skies.value = answer.skies.map(({ name, picture }) => ({
            name,
            label: title(name),
            picture: blobUrl(picture),
          }));
      });
  }, []);
  const now = state.value;
  if (!now) return null;
  const layer = lightLayer.value;
  const view = camera.value;
  return (
    // what a press or a key begins is a step of its own
    <div
      onPointerDownCapture={beginGesture}
      onKeyDownCapture={(event) => !event.repeat && beginGesture()}
      onInputCapture={(event) => isColor(event.target) && hold()}
      onChangeCapture={(event) => isColor(event.target) && void letGo()}
    >
      <LightPanel
        lights={shownLights.value}
        skies={skies.value ?? []}
        asset={{ ...now.asset, center: now.asset.center.map((value, k) => value + now.asset.offset[k]) }}
        viewAzimuth={view ? azimuthOf(view.world_to_camera, now.asset.up) : 0}
        disabled={readOnly.value}
        onChange={(lights) => void changeLights(lights)}
      >
        {layer ? (
          <p class="row">
            <b>{layer.name}</b>
            <Button
              icon={layer.visible ? "eye" : "hidden"}
              label={layer.visible ? "Before: hide this light" : "After: show this light"}
              pressed={!layer.visible}
              disabled={readOnly.value}
              onClick={() => void toggleLight(layer)}
            />
            <Button
              icon="plus"
              label="Another light, as a layer of its own"
              disabled={readOnly.value}
              onClick={anotherLight}
            />
          </p>
        ) : (
          <p class="quiet">
            Choose a sky, or add a sun or a lamp: it is a layer at once
            {selectedCount.value > 0 && `, on what is selected (${selectedCount.value.toLocaleString()} Gaussians)`}.
          </p>
        )}
      </LightPanel>
    </div>
  );
}

/** The light panel on the chosen light layer, or on one that is to be made. */

import { useEffect } from "preact/hooks";

import {
  anotherLight,
  beginGesture,
  changeLights,
  hold,
  letGo,
  linkedTo,
  lightLayer,
  selectedLamp,
  shownLights,
  takeLightOut,
  toggleLight,
} from "../lights/light-layers";
import { learnSkies, lightsOfRig, matchPictures, rigs, skies, skyFromFile } from "../lights/light-files";
import { azimuthOf } from "../lights/sun-ball";
import type { SkyInfo } from "../messages";
import { blobUrl } from "../net/blobs";
import { selectedCount } from "../paint/selected";
import { camera, readOnly, state } from "../state/store";
import { LightPanel, type Sky } from "./light-panel";
import { Button } from "./parts";
import { SunAt } from "./sun-at";

const shownSky = ({ name, picture, held }: SkyInfo): Sky => ({
  name,
  label: held ? name : name[0].toUpperCase() + name.slice(1),
  held: held ?? "",
  picture: blobUrl(picture),
});

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
  const layer = lightLayer.value;
  const held = shownLights.value.held;
  useEffect(() => {
    if (skies.value === null || (held && !skies.value.some((one) => one.held === held))) void learnSkies();
  }, [held]);
  const now = state.value;
  if (!now) return null;
  const view = camera.value;
  return (
    // what a press or a key begins is a step of its own
    <div
      onPointerDownCapture={beginGesture}
      onKeyDownCapture={(event) => !event.repeat && beginGesture()}
      onInputCapture={(event) => isColor(event.target) && hold()}
      // a colour or a choice out of a window of the browser, which takes the pointer's end with it
      onChangeCapture={() => void letGo()}
    >
      <LightPanel
        lights={shownLights.value}
        skies={(skies.value ?? []).map(shownSky)}
        rigs={rigs.value}
        onSkyFile={(file) => void skyFromFile(file)}
        onRig={(rig) => void lightsOfRig(rig)}
        onMatch={(files) => void matchPictures(files)}
        lamp={selectedLamp.value}
        onLamp={(id) => (selectedLamp.value = id)}
        placeOfSun={({ id }) => <SunAt id={id} name="the sun" disabled={readOnly.value} />}
        asset={{ ...now.asset, center: now.asset.center.map((value, k) => value + now.asset.offset[k]) }}
        viewAzimuth={view ? azimuthOf(view.world_to_camera, now.asset.up) : 0}
        disabled={readOnly.value}
        onChange={(lights) => void changeLights(lights)}
      >
        {layer ? (
          <p class="row">
            <b>{layer.name}</b>
            {linkedTo(layer).length > 1 && <span class="quiet">of {linkedTo(layer).length} assets</span>}
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
          <>
            <p class="row">
              <Button
                label="Take the light that is there out, as a layer"
                text="Take the light out"
                disabled={readOnly.value}
                onClick={() => void takeLightOut()}
              />
            </p>
            <p class="quiet">
              Choose a sky, or add a sun or a lamp: it is a layer at once
              {selectedCount.value > 0 && `, on what is selected (${selectedCount.value.toLocaleString()} Gaussians)`}.
            </p>
          </>
        )}
      </LightPanel>
    </div>
  );
}

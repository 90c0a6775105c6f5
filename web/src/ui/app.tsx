/** The window: header, tool settings, tools, view, panels, status line; and files dropped anywhere on it. */

import { signal } from "@preact/signals";
import { useEffect } from "preact/hooks";

import { addPicture } from "../state/dropped-images";
import { camera, panelsFolded, state, tab, type Tab } from "../state/store";
import { inHand } from "../tools";
import { placePicture } from "../tools/stamp";
import { BatchDialog } from "./batch";
import { AssetHandles } from "./asset-handles";
import { LampHandles } from "./lamp-handles";
import { Assets } from "./assets";
import { BrushPanel } from "./brush-panel";
import { ColorsPanel } from "./colors-panel";
import { Away, Jobs, Loading, StatusLine, Toasts } from "./feedback";
import { listenToDrops } from "./drops";
import { Continue, Files, openFile, Swapped } from "./files";
import { Gizmo } from "./gizmo";
import { filesOpen, Header } from "./header";
import { Help } from "./help";
import { History } from "./history";
import { Layers } from "./layers";
import { Adjustments } from "./adjustments";
import { LightTab } from "./light-tab";
import { Options } from "./options";
import { Pictures } from "./pictures";
import { ReceiptPanel } from "./receipt";
import { SelectionChip, SelectionPanel } from "./selection";
import { Stage } from "./stage";
import { StorageProblem } from "./storage";
import { Toolbar } from "./toolbar";
import { Tour } from "./tour";
import { Views } from "./views";

const TABS: readonly (readonly [Tab, string, () => preact.JSX.Element | null])[] = [
  ["brush", "Brush", BrushPanel],
  ["colors", "Colours", ColorsPanel],
  ["history", "History", History],
  ["adjust", "Adjust", Adjustments],
  ["light", "Light", LightTab],
  ["select", "Select", SelectionPanel],
  ["pictures", "Pictures", Pictures],
  ["views", "Views", Views],
  ["receipt", "Receipt", ReceiptPanel],
];
const dropping = signal(false);
const isPicture = (file: File) => /^image\/(png|jpeg|webp)$/.test(file.type);
/** Pictures that no browser shows, and the server reads. */
const isOtherPicture = (file: File) => /\.(tiff?|exr|hdr|psd|psb|ora|kra)$/i.test(file.name);

function take(files: File[]): void {
  for (const file of files) {
    if (isPicture(file) && inHand().takesPictures && camera.value) void placePicture(file, file.name);
    else if (isPicture(file) || isOtherPicture(file)) void addPicture(file);
    else void openFile(file);
  }
}

export function App({ canvas }: { canvas: HTMLCanvasElement }) {
  useEffect(() => {
    const paste = (event: ClipboardEvent) => take([...(event.clipboardData?.files ?? [])].filter(isPicture));
    window.addEventListener("paste", paste);
    return () => window.removeEventListener("paste", paste);
  }, []);
  useEffect(() => listenToDrops((over) => (dropping.value = over), take), []);
  return (
    <div class={`app${panelsFolded.value ? " folded" : ""}`}>
      <Header />
      <Options />
      <Toolbar />
      <main class="middle">
        <h1 class="unseen">SplatPainter studio</h1>
        <Stage canvas={canvas} />
        {state.value && <AssetHandles />}
        <LampHandles />
        {state.value && <Gizmo />}
        <Loading />
        <SelectionChip />
        <Swapped />
        <StorageProblem />
        <Jobs />
        <Toasts />
        <Away />
        {dropping.value && <div class="dropping">Drop an edited picture, an asset, a project, or a layer</div>}
      </main>
      <aside class="side" aria-label="Panels">
        <Assets />
        <Layers />
        <section class="panel tabs">
          <div role="tablist" aria-label="Panels" class="tab-list">
            {TABS.map(([key, name]) => (
              <button
                type="button"
                key={key}
                role="tab"
                id={`tab-${key}`}
                aria-selected={tab.value === key}
                aria-controls="tab-panel"
                tabIndex={tab.value === key ? 0 : -1}
                onClick={() => (tab.value = key)}
                onKeyDown={moveTab}
              >
                {name}
              </button>
            ))}
          </div>
          <div
            key={tab.value}
            role="tabpanel"
            id="tab-panel"
            aria-labelledby={`tab-${tab.value}`}
            class="tab-panel"
            tabIndex={0}
          >
            {TABS.map(([key, , Panel]) => tab.value === key && <Panel key={key} />)}
          </div>
        </section>
      </aside>
      <StatusLine />
      <Help />
      <Continue />
      <Tour />
      <BatchDialog />
      {filesOpen.value && (
        <Files key={filesOpen.value} saving={filesOpen.value === "save"} onClose={() => (filesOpen.value = null)} />
      )}
    </div>
  );
}

function moveTab(event: KeyboardEvent): void {
  const step = event.key === "ArrowRight" ? 1 : event.key === "ArrowLeft" ? -1 : 0;
  if (!step) return;
  event.preventDefault();
  event.stopPropagation();
  const at = TABS.findIndex(([key]) => key === tab.value);
  tab.value = TABS[(at + step + TABS.length) % TABS.length][0];
  document.getElementById(`tab-${tab.value}`)?.focus();
}

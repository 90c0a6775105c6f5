/** The project cannot be written: the strokes that wait for it, and where the project could go on. */

import { useEffect } from "preact/hooks";

import { pendingStrokes, toast } from "../state/store";
import { run } from "../editor/editor";
import { answerStorage, roomyFolders, storageProblem, storageWords } from "../state/storage";
import { Button } from "./parts";

const gigabytes = (bytes: number): string => `${(bytes / 1e9).toFixed(bytes < 1e10 ? 1 : 0)} GB free`;

async function moveTo(folder: "studio" | "projects" | "home" | "temporary"): Promise<void> {
  const answer = await run("project.move", { folder }, "Saving elsewhere");
  if (!answer) return;
  toast("info", `The project is in ${answer.folder} now: ${answer.file}.`);
  answerStorage(true);
}

export function StorageProblem() {
  const problem = storageProblem.value;
  useEffect(() => {
    if (problem && roomyFolders.value === null)
      void run("project.folders", {}).then((answer) => (roomyFolders.value = answer?.folders ?? []));
  }, [problem]);
  if (!problem) return null;
  const drawn = pendingStrokes.value;
  return (
    <div class="elsewhere swapped" role="alert">
      <span>{storageWords(problem.message, drawn)}</span>
      <Button label="Try again" text="Try again" primary onClick={() => answerStorage(true)} />
      {(roomyFolders.value ?? []).map((folder) => (
        <Button
          key={folder.key}
          label={`Go on in ${folder.name}`}
          text={`Save it in ${folder.name} (${gigabytes(folder.free)})`}
          onClick={() => void moveTo(folder.key)}
        />
      ))}
      <Button
        label={drawn > 0 ? "Give up what waits" : "Close"}
        text={drawn > 0 ? "Give up what waits" : "Close"}
        onClick={() => answerStorage(false)}
      />
    </div>
  );
}

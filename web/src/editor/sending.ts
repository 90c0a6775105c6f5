/** Files on their way to the server, with a bar beside those of commands. */

import { sendSlowly } from "../net/blobs";
import { jobs } from "../state/store";
import { report } from "./editor";

let sendings = 0;

/** Send a file, and say what went wrong. Returns the name by which commands refer to it; null: it was not sent. */
export async function sendWithBar(file: File): Promise<string | null> {
  const abort = new AbortController();
  const id = -++sendings; // those of commands are above 0
  const label = `Sending ${file.name}`;
  jobs.value = [...jobs.value, { id, label, progress: 0, stage: "", cancel: () => abort.abort() }];
  const show = (progress: number) =>
    (jobs.value = jobs.value.map((job) => (job.id === id ? { ...job, progress } : job)));
  try {
    return await sendSlowly(file, show, abort.signal);
  } catch (error) {
    report(error, label);
    return null;
  } finally {
    jobs.value = jobs.value.filter((job) => job.id !== id);
  }
}

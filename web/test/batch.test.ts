/** The server's batch: answers and events come over different ways, and may overtake one another. */

import { expect, test } from "vitest";

import type { BatchAnswer, BatchEvent, BatchInfo, BatchJobInfo } from "../src/messages";
import { applyBatch, batch, learnBatch } from "../src/state/batch";

const job = (number: number, state: BatchJobInfo["state"]) => ({ number, state }) as BatchJobInfo;
const info = (state: BatchInfo["state"], ...jobs: BatchJobInfo[]): BatchInfo => ({
  id: "a",
  state,
  title: "",
  jobs,
  page_url: null,
  zip_url: null,
});
const answer = (revision: number, batch: BatchInfo | null) => ({ revision, batch }) as BatchAnswer;
const event = (revision: number, batch: BatchInfo | null, job: BatchJobInfo | null = null): BatchEvent => ({
  event: "batch",
  revision,
  batch,
  id: "a",
  job,
  zip_url: null,
});

test("an answer that an event has overtaken takes nothing back", async () => {
  await learnBatch(async () => answer(0, null));
  applyBatch(event(1, info("running", job(0, "queued"))));
  applyBatch(event(2, null, job(0, "running")));
  applyBatch(answer(1, info("running", job(0, "queued")))); // to the command that started it
  expect(batch.value?.jobs[0].state).toBe("running");
  applyBatch(event(4, info("cancelled", job(0, "cancelled"))));
  applyBatch(answer(3, info("cancelling", job(0, "running"))));
  expect(batch.value?.state).toBe("cancelled");
  applyBatch(event(5, null));
  expect(batch.value).toBeNull();
});

test("jobs that changed before the batch was known are asked for again", async () => {
  const answers = [answer(3, info("running", job(0, "queued"))), answer(4, info("running", job(0, "done")))];
  await learnBatch(async () => {
    applyBatch(event(4, null, job(0, "done")));
    return answers.shift()!;
  });
  expect(answers).toEqual([]);
  expect(batch.value?.jobs.map(({ state }) => state)).toEqual(["done"]);
});

test("another server's revisions begin anew", async () => {
  await learnBatch(async () => answer(90, info("done")));
  await learnBatch(async () => answer(0, null));
  expect(batch.value).toBeNull();
});

import { afterAll, expect, it, vi } from "vitest";

import type { PictureChecked } from "../src/messages";

/** Checks that the server was sent, and their ends. */
const server = {
  sent: [] as { fields: { picture: string; threshold: number | null }; end: (answer: object) => void }[],
};

// Files of tests share their modules: these are loaded anew for this one, with other ends of the connection.
vi.resetModules();
vi.doMock("../src/net/blobs", () => ({
  blobUrl: (blob: string) => blob,
  sendBlob: (file: File) => file.text(),
}));
vi.doMock("../src/editor/editor", () => ({
  editor: {
    link: {
      do: (_name: string, fields: { picture: string; threshold: number | null }) =>
        new Promise((resolve) => server.sent.push({ fields, end: resolve })),
    },
  },
  report: (error: unknown) => Promise.reject(error),
  run: () => Promise.resolve(null),
}));
const { addPicture, check, droppedImages, setThreshold } = await import("../src/state/dropped-images");
afterAll(() => {
  vi.doUnmock("../src/net/blobs");
  vi.doUnmock("../src/editor/editor");
  vi.resetModules();
});

const checked = (share: number) => ({ share, camera_source: "chunk" }) as PictureChecked;
const send = async (content: string): Promise<void> => {
  void addPicture(new File([content], "view.png"));
  await vi.waitFor(() => expect(server.sent.at(-1)?.fields.picture).toBe(content));
};
const end = async (share: number): Promise<void> => {
  server.sent.shift()!.end(checked(share));
  for (let k = 0; k < 5; k++) await Promise.resolve();
};

it("the check of a picture is of its newest threshold and content, whichever answer comes when", async () => {
  await send("first");
  const [{ id }] = droppedImages.value;
  await end(0.5);
  expect(droppedImages.value[0].checked?.share).toBe(0.5);

  setThreshold(id, 0.1);
  void check(id);
  setThreshold(id, 0.2);
  expect(droppedImages.value[0].threshold).toBe(0.2); // while it is dragged
  await end(0.4);
  expect(droppedImages.value[0]).toMatchObject({ threshold: 0.2, checked: { share: 0.5 } });
  void check(id);
  expect(server.sent[0].fields.threshold).toBe(0.2);
  await end(0.3);
  expect(droppedImages.value[0]).toMatchObject({ threshold: 0.2, checked: { share: 0.3 } });

  void check(id);
  await send("saved over");
  await end(0.2);
  expect(droppedImages.value[0].checked).toBeNull();
  await end(0.1);
  expect(droppedImages.value[0].checked?.share).toBe(0.1);
});

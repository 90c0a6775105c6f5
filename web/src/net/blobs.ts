/** Big things in and out over HTTP. */

import { CommandError } from "./connection";

/** Send bytes; returns the name (SHA-256) by which commands refer to them. */
export async function sendBlob(body: Blob, name = "", signal?: AbortSignal): Promise<string> {
  const response = await fetch(`/api/blobs${name ? `?name=${encodeURIComponent(name)}` : ""}`, {
    method: "POST",
    body,
    signal,
    headers: { "content-type": "application/octet-stream" },
  });
  const answer = (await response.json().catch(() => ({}))) as {
    blob?: string;
    error?: { message: string; hint?: string };
  };
  if (!response.ok || !answer.blob)
    throw new CommandError(
      "input",
      answer.error?.message ?? `The file could not be sent (${response.status}).`,
      answer.error?.hint,
    );
  return answer.blob;
}

/** `sendBlob` that tells how far it is, 0 .. 1. */
export function sendSlowly(file: File, onShare: (share: number) => void, signal: AbortSignal): Promise<string> {
  return new Promise((resolve, reject) => {
    const request = new XMLHttpRequest(); // fetch says nothing of what it has sent
    request.open("POST", `/api/blobs?name=${encodeURIComponent(file.name)}`);
    request.setRequestHeader("content-type", "application/octet-stream");
    request.responseType = "json";
    request.upload.onprogress = ({ loaded, total }) => onShare(total ? loaded / total : 0);
    request.onload = () => {
      const answer = (request.response ?? {}) as { blob?: string; error?: { message: string; hint?: string } };
      if (answer.blob) resolve(answer.blob);
      else {
        const message = answer.error?.message ?? `The file could not be sent (${request.status}).`;
        reject(new CommandError("input", message, answer.error?.hint));
      }
    };
    request.onerror = () => reject(new CommandError("input", "The file could not be sent: the connection is gone."));
    request.onabort = () => reject(new CommandError("cancelled", "Cancelled."));
    signal.addEventListener("abort", () => request.abort());
    request.send(file);
  });
}

export const blobUrl = (blob: string): string => `/api/blobs/${blob}`;

/** Offer a file for download. */
export function download(url: string, name: string): void {
  const link = document.createElement("a");
  link.href = url;
  link.download = name;
  link.click();
}

/** The pixels of a picture, at its size or at `width` x `height`. */
export async function pixelsOf(source: string | Blob, width?: number, height?: number): Promise<ImageData> {
  const blob = typeof source === "string" ? await (await fetch(source)).blob() : source;
  const bitmap = await createImageBitmap(blob);
  const canvas = new OffscreenCanvas(width ?? bitmap.width, height ?? bitmap.height);
  const context = canvas.getContext("2d")!;
  context.drawImage(bitmap, 0, 0, canvas.width, canvas.height);
  bitmap.close();
  return context.getImageData(0, 0, canvas.width, canvas.height);
}

/** After a build, write build.json: the hash of everything that the bundle was made from. A Python test compares it. */

import { createHash } from "node:crypto";
import { readdirSync, readFileSync, statSync, writeFileSync } from "node:fs";
import { join, relative, sep } from "node:path";
import type { Plugin } from "vite";

const ROOT = join(import.meta.dirname, "..");
const SOURCES = [
  "index.html",
  "package-lock.json",
  "package.json",
  "public",
  "scripts",
  "src",
  "tsconfig.json",
  "vite.config.ts",
];

/** SHA-256 over "path\0size\0bytes" of every source in path order, paths with slashes. */
export function sourceHash(root = ROOT): string {
  const files = SOURCES.flatMap((name) => list(join(root, name))).map((path) => ({
    path,
    name: relative(root, path).split(sep).join("/"),
  }));
  const digest = createHash("sha256");
  for (const { path, name } of files.sort((a, b) => (a.name < b.name ? -1 : 1))) {
    const bytes = readFileSync(path);
    digest.update(`${name}\0${bytes.length}\0`).update(bytes);
  }
  return digest.digest("hex");
}

export function record(): Plugin {
  let out = "";
  return {
    name: "record",
    apply: "build",
    configResolved: (config) => void (out = join(config.root, config.build.outDir)),
    closeBundle: () =>
      writeFileSync(join(out, "build.json"), `${JSON.stringify({ sources: sourceHash() }, null, 2)}\n`),
  };
}

function list(path: string): string[] {
  return statSync(path).isDirectory() ? readdirSync(path).flatMap((name) => list(join(path, name))) : [path];
}

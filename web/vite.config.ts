import { defineConfig } from "vitest/config";

import { record } from "./scripts/record.ts";

/** What draws Gaussians: the studio and the page of its own (src/page) share it, so that it is in the bundle once. */
const ENGINE = /node_modules[\\/](three|@sparkjsdev|fflate)[\\/]|src[\\/](view|splats)[\\/]/;

/**
 * The studio's script and style sheet, the script of the page of its own, and what both share; no maps, names without hashes:
 * the bundle is committed and must not move by itself.
 */
export default defineConfig({
  base: "/",
  plugins: [record()],
  build: {
    outDir: "../src/splatpainter/server/static",
    emptyOutDir: true,
    target: "es2022",
    cssCodeSplit: false,
    modulePreload: false,
    reportCompressedSize: false,
    chunkSizeWarningLimit: 5000,
    rollupOptions: {
      input: { studio: "index.html", viewer: "src/page/main.ts" },
      preserveEntrySignatures: "strict",
      output: {
        entryFileNames: "[name].js",
        chunkFileNames: "[name].js",
        assetFileNames: "studio[extname]",
        codeSplitting: { groups: [{ name: "engine", test: ENGINE }] },
      },
    },
  },
  server: { proxy: { "/api": "http://127.0.0.1:8750", "/ws": { target: "ws://127.0.0.1:8750", ws: true } } },
  test: { include: ["test/**/*.test.ts"], environment: "node" },
});

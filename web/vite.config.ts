import { defineConfig } from "vitest/config";

import { record } from "./scripts/record.ts";

/** One script, one style sheet, no maps, names without hashes: the bundle is committed and must not move by itself. */
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
      output: {
        entryFileNames: "studio.js",
        chunkFileNames: "[name].js",
        assetFileNames: "studio[extname]",
        codeSplitting: false,
      },
    },
  },
  server: { proxy: { "/api": "http://127.0.0.1:8750", "/ws": { target: "ws://127.0.0.1:8750", ws: true } } },
  test: { include: ["test/**/*.test.ts"], environment: "node" },
});

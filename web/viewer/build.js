// Bundles src into dist, which is checked in: `cargo build` needs no npm.
//
//   npm ci && npm run build      writes dist anew
//   npm run check                fails if dist is not what src and the lock file give (no packages needed)
//
// dist/sources.txt is a digest of everything that goes into dist. The check compares digests, so that it is the
// same on every machine; a test of the gateway compares them too.
import { createHash } from "node:crypto";
import { mkdirSync, readFileSync, readdirSync, rmSync, writeFileSync } from "node:fs";
import { dirname, join } from "node:path";
import { fileURLToPath } from "node:url";

const here = dirname(fileURLToPath(import.meta.url));
const at = (...parts) => join(here, ...parts);
const sources = ["build.js", "package-lock.json", ...readdirSync(at("src")).sort().map((name) => `src/${name}`)];

function digest() {
  const hash = createHash("sha256");
  for (const name of sources) {
    const bytes = readFileSync(at(name));
    hash.update(`${name} ${bytes.length}\n`).update(bytes);
  }
  return `${hash.digest("hex")}\n`;
}

if (process.argv.includes("--check")) {
  const found = readFileSync(at("dist", "sources.txt"), "utf8");
  if (found !== digest()) {
    console.error("web/viewer/dist is older than its sources: run `npm ci && npm run build` in web/viewer and commit dist");
    process.exit(1);
  }
} else {
  const { build } = await import("esbuild");
  rmSync(at("dist"), { recursive: true, force: true });
  mkdirSync(at("dist"));
  await build({
    entryPoints: [at("src", "main.js")],
    outfile: at("dist", "page.js"),
    bundle: true,
    minify: true,
    format: "esm",
    target: "es2022",
    legalComments: "external",
    loader: { ".glsl": "text" },
  });
  for (const name of ["index.html", "style.css"]) {
    writeFileSync(at("dist", name), readFileSync(at("src", name)));
  }
  writeFileSync(at("dist", "sources.txt"), digest());
}

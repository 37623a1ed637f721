// Bundles src into dist, which is checked in: `cargo build` needs no npm.
//
//   npm ci && npm run build      writes dist anew
//   npm run check                fails if dist is not what src and the lock file give
//
// dist/sources.txt is a digest of everything that goes into dist. The check compares digests, which needs no
// packages (a test of the gateway does the same); where esbuild is installed it bundles again and compares bytes.
import { existsSync, mkdirSync, readFileSync, readdirSync, rmSync, writeFileSync } from "node:fs";
import { basename, dirname, join } from "node:path";
import { fileURLToPath } from "node:url";

const here = dirname(fileURLToPath(import.meta.url));
const at = (...parts) => join(here, ...parts);
const sources = ["build.js", "package-lock.json", ...readdirSync(at("src")).sort().map((name) => `src/${name}`)];

/** 64-bit FNV-1a over names, lengths and bytes: a test in Rust computes it without a crate. */
function digest() {
  let hash = 0xcbf29ce484222325n;
  const update = (bytes) => {
    for (const byte of bytes) hash = BigInt.asUintN(64, (hash ^ BigInt(byte)) * 0x100000001b3n);
  };
  for (const name of sources) {
    const bytes = readFileSync(at(name));
    update(Buffer.from(`${name} ${bytes.length}\n`));
    update(bytes);
  }
  return `${hash.toString(16).padStart(16, "0")}\n`;
}

/** Every file of dist, by name. */
async function bundled() {
  const { build } = await import("esbuild");
  const result = await build({
    entryPoints: [at("src", "main.js")],
    outfile: at("dist", "page.js"),
    bundle: true,
    minify: true,
    format: "esm",
    target: "es2022",
    legalComments: "external",
    write: false,
  });
  const files = result.outputFiles.map((file) => [basename(file.path), Buffer.from(file.contents)]);
  for (const name of ["index.html", "style.css"]) files.push([name, readFileSync(at("src", name))]);
  return [...files, ["sources.txt", Buffer.from(digest())]];
}

if (process.argv.includes("--check")) {
  const older = readFileSync(at("dist", "sources.txt"), "utf8") !== digest();
  const files = existsSync(at("node_modules", "esbuild")) ? await bundled() : [];
  const other = files.filter(([name, bytes]) => !existsSync(at("dist", name)) || !readFileSync(at("dist", name)).equals(bytes));
  if (older || other.length) {
    console.error(`web/viewer/dist is not made of its sources (${older ? "sources.txt" : other.map(([name]) => name)}): run \`npm ci && npm run build\` in web/viewer and commit dist`);
    process.exit(1);
  }
} else {
  const files = await bundled();
  rmSync(at("dist"), { recursive: true, force: true });
  mkdirSync(at("dist"));
  for (const [name, bytes] of files) writeFileSync(at("dist", name), bytes);
}

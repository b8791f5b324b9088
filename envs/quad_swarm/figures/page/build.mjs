// Bundles the sources of this folder into ../replay.html, which the Python package ships: `make page`.

import {createHash} from "node:crypto";
import {readdirSync, readFileSync, writeFileSync} from "node:fs";
import {build} from "esbuild";

const folder = new URL("./", import.meta.url);
const read = name => readFileSync(new URL(name, folder), "utf8");

// tests/quad_swarm/figures/test_replay.py computes the same, so that nobody forgets to build
const sources = readdirSync(folder).filter(name => /\.(js|mjs|css|html|json)$/.test(name)).sort();
const sum = createHash("sha256");
for (const name of sources) sum.update(`${name}\n${read(name)}\n`);

async function bundle(name, options) {
  const result = await build({
    entryPoints: [new URL(name, folder).pathname], bundle: true, minify: true, write: false, target: "es2022", legalComments: "none", ...options,
  });
  return result.outputFiles[0].text.trim();
}

const script = await bundle("main.js", {format: "iife", charset: "ascii"});
const style = await bundle("page.css", {});
const licence = read("node_modules/three/LICENSE").trim();
const {dependencies} = JSON.parse(read("package.json"));
const header = `<!--
Built by \`make page\` from envs/quad_swarm/figures/page; do not edit. SHA-256 of the sources: ${sum.digest("hex")}

Contains three.js ${dependencies.three} (https://threejs.org):

${licence}
-->`;
// Functions, because "$&" in a text would be replaced once more
const page = read("page.html").replace("<!DOCTYPE html>\n", start => `${start}${header}\n`)
  .replace("__STYLE__", () => style).replace("__SCRIPT__", () => script);
writeFileSync(new URL("../replay.html", folder), page);
writeFileSync(new URL("../three.LICENSE.txt", folder), `${licence}\n`);
console.log(`replay.html: ${(page.length / 1e6).toFixed(2)} MB`);

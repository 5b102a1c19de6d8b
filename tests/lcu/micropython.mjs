// Runs a script under MicroPython: node micropython.mjs MODULE TREE SCRIPT
// All files of the folder TREE are put into its file system at "/". A line "# ---" ends a part of
// the script: between two parts memory is collected, which this build of MicroPython does only
// while no Python runs (it cannot look into WebAssembly's stack).
import fs from "node:fs";
import path from "node:path";
import { pathToFileURL } from "node:url";

const [module, tree, script] = process.argv.slice(2);
const { loadMicroPython } = await import(pathToFileURL(module).href);
const mp = await loadMicroPython({ linebuffer: true, stdout: (line) => console.log(line) });

function put(folder, at) {
  for (const entry of fs.readdirSync(folder, { withFileTypes: true })) {
    const from = path.join(folder, entry.name);
    if (entry.isDirectory()) {
      mp.FS.mkdir(`${at}${entry.name}`);
      put(from, `${at}${entry.name}/`);
    } else {
      mp.FS.writeFile(`${at}${entry.name}`, fs.readFileSync(from));
    }
  }
}

put(tree, "/");
try {
  mp.runPython(`import gc, sys; sys.path.insert(0, "/")`);
  for (const part of fs.readFileSync(path.join(tree, script), "utf8").split("\n# ---\n")) {
    mp.runPython("gc.collect()");
    mp.runPython(part);
  }
} catch (error) {
  console.error(String(error));
  process.exit(1);
}

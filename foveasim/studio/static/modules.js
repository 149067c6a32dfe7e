// Modules of the page that are loaded when they are needed.

import { awaited } from "./pending.js";

/** @type {Map<string, number>} */
const nFailed = new Map();

// Imports a module, also after an attempt without a server: browsers remember the address of a module that could not be loaded.
/** @param {string} path */
export async function load(path) {
  const n = nFailed.get(path) ?? 0;
  try {
    return await awaited(import(path + (n ? "?attempt=" + (n + 1) : "")));
  } catch (error) {
    nFailed.set(path, n + 1);
    throw error;
  }
}

// What the browser keeps of the page: in its tab, such as the session, and for its address, such as the panes. It may not permit that.

/** @param {() => Storage} storage */
const memoryOf = (storage) => ({
  /** @type {(name: string) => string | null} */
  get(name) { try { return storage().getItem("foveasim-studio-" + name); } catch { return null; } },
  // A value that was kept as JSON; null for none.
  /** @type {(name: string) => any} */
  read(name) { try { return JSON.parse(this.get(name) ?? "null"); } catch { return null; } },
  /** @type {(name: string, text: string) => void} */
  set(name, text) { try { storage().setItem("foveasim-studio-" + name, text); } catch { /* not kept */ } },
});

export const memory = memoryOf(() => sessionStorage);
export const lasting = memoryOf(() => localStorage);

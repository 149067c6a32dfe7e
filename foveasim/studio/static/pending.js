// What will change the page without a further action of its user: modules and files that are read, and frames of the browser.

let nPending = 0;

export const isPending = () => nPending > 0;

// Returns a function that ends what begins now.
export function begin() {
  let isOver = false;
  nPending++;
  return () => {
    if (!isOver) nPending--;
    isOver = true;
  };
}

// Resolves as a promise, which is pending until then.
/** @type {<T>(promise: Promise<T>) => Promise<T>} */
export async function awaited(promise) {
  const end = begin();
  try { return await promise; } finally { end(); }
}

// Work in the next frame of the browser.

// Browsers may draw no frame for a long time, for example after their graphics process was busy: the work is then done anyway.
const LATE_MS = 1000;

export function inNextFrame(work) {
  let isDone = false;
  const once = () => {
    if (isDone) return;
    isDone = true;
    clearTimeout(timer);
    work();
  };
  const timer = setTimeout(once, LATE_MS);
  requestAnimationFrame(once);
}

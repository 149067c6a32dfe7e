// Links that contain the settings: compressed, in the fragment of the address, which browsers do not send.

// Largest size of the settings in a link, characters, and of the link.
const MAX_TEXT = 512 * 1024;
const MAX_LINK = 256 * 1024;
const KEY = "state=";

async function through(stream, bytes, limit = Infinity) {
  const reader = new Blob([bytes]).stream().pipeThrough(stream).getReader(), pieces = [];
  let size = 0;
  for (;;) {
    const { done, value } = await reader.read();
    if (done) break;
    size += value.length;
    if (size > limit) {
      await reader.cancel();
      throw new Error("too large");
    }
    pieces.push(value);
  }
  return new Uint8Array(await new Blob(pieces).arrayBuffer());
}

// Returns the fragment of an address for settings in JSON; with a token it opens the studio that has it.
export async function fragmentOf(text, token = "") {
  const bytes = await through(new CompressionStream("deflate-raw"), new TextEncoder().encode(text));
  let binary = "";
  for (let k = 0; k < bytes.length; k += 8192) binary += String.fromCharCode(...bytes.subarray(k, k + 8192));
  return (token ? token + "&" : "") + KEY + btoa(binary).replaceAll("+", "-").replaceAll("/", "_").replace(/=+$/, "");
}

// Returns the compressed settings of a link, of its fragment, or null.
export function stateOf(link) {
  const part = link.trim().split(/[#&]/).find((each) => each.startsWith(KEY));
  return part ? part.slice(KEY.length) : null;
}

// Returns { settings } of compressed settings, or { error } in one line. The server checks the settings.
export async function settingsOf(compressed) {
  if (compressed.length > MAX_LINK) return { error: "The link is too long" };
  try {
    const binary = atob(compressed.replaceAll("-", "+").replaceAll("_", "/")), bytes = Uint8Array.from(binary, (c) => c.charCodeAt(0));
    const text = new TextDecoder("utf-8", { fatal: true }).decode(await through(new DecompressionStream("deflate-raw"), bytes, MAX_TEXT));
    const settings = JSON.parse(text);
    if (settings === null || typeof settings !== "object" || Array.isArray(settings)) throw new Error("no mapping");
    return { settings };
  } catch {
    return { error: "The link is incomplete, or not one of the studio" };
  }
}

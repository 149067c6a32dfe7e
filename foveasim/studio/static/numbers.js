// Numbers as people write them: fractions, products, decimal commas, and units with metric prefixes; and as the page shows them.

export { quantity, unitText } from "/web/colours.js";

const PREFIXES = { G: 1e9, M: 1e6, k: 1e3, "": 1, c: 1e-2, m: 1e-3, µ: 1e-6, μ: 1e-6, u: 1e-6, n: 1e-9, p: 1e-12, f: 1e-15, a: 1e-18 };
// Units that a setting can have, and those with the same dimension: prefix of the setting, and its base.
const BASES = { s: ["", "s"], V: ["", "V"], F: ["", "F"], m: ["", "m"], mm: ["m", "m"], µm: ["µ", "m"], nm: ["n", "m"],
  "Gbit/s": ["G", "bit/s"] };
// Other spellings of units without prefixes.
const SPELLINGS = { degrees: ["°", "deg", "degree", "degrees"], "e-": ["e", "e-", "e−"], lx: ["lx", "lux"], lux: ["lx", "lux"] };

// Value of an arithmetic expression of numbers, + - * / × ÷ and parentheses; NaN if it is none.
/** @type {(text: string) => number} */
function evaluate(text) {
  const tokens = text.match(/\d+\.?\d*(?:e[+-]?\d+)?|\.\d+(?:e[+-]?\d+)?|[-+*/()]/gi) || [];
  let i = 0;
  const next = (...wanted) => (wanted.includes(tokens[i]) ? tokens[i++] : null);
  /** @type {(depth: number) => number} */
  const term = (depth) => {
    let value = factor(depth);
    for (let sign = next("*", "/"); sign; sign = next("*", "/")) value = sign === "*" ? value * factor(depth) : value / factor(depth);
    return value;
  };
  /** @type {(depth: number) => number} */
  const sum = (depth) => {
    let value = term(depth);
    for (let sign = next("+", "-"); sign; sign = next("+", "-")) value = sign === "+" ? value + term(depth) : value - term(depth);
    return value;
  };
  /** @type {(depth: number) => number} */
  const factor = (depth) => {
    if (depth > 50) return NaN;
    if (next("-")) return -factor(depth + 1);
    if (next("+")) return factor(depth + 1);
    if (next("(")) {
      const value = sum(depth + 1);
      return next(")") ? value : NaN;
    }
    const token = tokens[i++];
    return token !== undefined && /^[\d.]/.test(token) ? Number(token) : NaN;
  };
  if (tokens.join("") !== text.replace(/\s+/g, "")) return NaN;
  const value = sum(0);
  return i === tokens.length ? value : NaN;
}

// Factor from a written unit to that of a setting; NaN if they do not belong together.
/** @type {(written: string, unit: string) => number} */
function factorOf(written, unit) {
  if (!written || written === unit || SPELLINGS[unit]?.includes(written)) return 1;
  if (written === "%") return unit === "fraction" || unit === "" ? 0.01 : NaN;
  const [own, base] = BASES[unit] || [];
  if (base === undefined || !written.endsWith(base)) return NaN;
  const prefix = written.slice(0, -base.length);
  return prefix in PREFIXES ? PREFIXES[prefix] / PREFIXES[own] : NaN;
}

// Returns the number of a text for a setting with a unit, such as 1/60, 20 ms, 3*2.2 or 0,02; NaN if it is none.
/** @param {string} text @param {string} unit */
export function numberOf(text, unit = "") {
  const plain = text.trim().replace(/[−–]/g, "-").replaceAll("×", "*").replaceAll("÷", "/");
  const [, number = "", written = ""] = /^(.*[\d.)])\s*([^\d\s.,()*/+]\S*)?$/.exec(plain) || [];
  // One comma without a point is a decimal comma, unless three digits follow it: 10,000.
  const isDecimal = /^[^.,]*,[^.,]*$/.test(number) && !/[1-9]\d*,\d{3}(?!\d)/.test(number);
  const decimal = isDecimal ? number.replace(",", ".") : number.replace(/(\d),(?=\d{3}(?!\d))/g, "$1");
  // 12 significant digits hide the rounding of prefixes.
  const value = evaluate(decimal) * factorOf(written, unit);
  return Number.isFinite(value) ? Number(value.toPrecision(12)) : NaN;
}

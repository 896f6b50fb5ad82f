// Conditions on a column of the table of trials, as a person writes them.

const NUMBER = String.raw`[+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?`;
const BOUND = new RegExp(`^(>=|<=|>|<|=|≥|≤)?\\s*(${NUMBER})$`, "i");
const RANGE = new RegExp(`^(${NUMBER})\\s*(?:\\.\\.|to)\\s*(${NUMBER})$`, "i");

/** @type {Record<string, (value: number, bound: number) => boolean>} */
const COMPARE = {
  ">": (value, bound) => value > bound,
  "<": (value, bound) => value < bound,
  ">=": (value, bound) => value >= bound,
  "≥": (value, bound) => value >= bound,
  "<=": (value, bound) => value <= bound,
  "≤": (value, bound) => value <= bound,
  "=": (value, bound) => value === bound,
};

/**
 * @param {string} text such as ">1.5", "<=2", "1..2", or "3", which means 3 as the table shows it
 * @param {(value: number) => string} shown the text of a value in the table
 * @returns {((value: any) => boolean) | null} whether a number keeps the condition; null if it is none
 */
export function numberFilter(text, shown) {
  const words = text.trim();
  const range = RANGE.exec(words);
  if (range) {
    const [lower, upper] = [Number(range[1]), Number(range[2])];
    return (value) => value !== null && value >= lower && value <= upper;
  }
  const bound = BOUND.exec(words);
  if (!bound) return null;
  const number = Number(bound[2]);
  const compare = bound[1] ? COMPARE[bound[1]] : null;
  return (value) => value !== null && (compare ? compare(value, number) : shown(value) === shown(number));
}

/**
 * @param {string} text part of an option
 * @returns {(option: any) => boolean} whether the text of an option has it
 */
export function textFilter(text) {
  const part = text.trim().toLowerCase();
  return (option) => String(option).toLowerCase().includes(part);
}

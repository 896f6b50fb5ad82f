// Light or dark: as the system has it, until a person chooses; and what a page remembers in its browser.

import { button } from "./common.js";

/** @typedef {"system" | "light" | "dark"} Choice */

/** @type {Choice[]} */
const CHOICES = ["system", "light", "dark"];
const SIGNS = { system: "◐", light: "☀", dark: "☾" };
const KEY = "vtb-theme"; // in the memory of the browser
// Meshcat's background, from above to below, each [red, green, blue] from 0 to 1.
const BACKGROUND = {
  light: { top_color: [0.95, 0.95, 1.0], bottom_color: [0.32, 0.32, 0.35] },
  dark: { top_color: [0.2, 0.22, 0.25], bottom_color: [0.09, 0.1, 0.11] },
};

/**
 * @param {string} key
 * @returns {any} what the browser remembers by the key; null if it has nothing, or no memory (in some frames)
 */
export function remembered(key) {
  try {
    return JSON.parse(localStorage.getItem(key) ?? "null");
  } catch {
    return null;
  }
}

/**
 * Lets the browser remember plain data for JSON, where it has a memory. Nothing that lets anybody in belongs there.
 *
 * @param {string} key
 * @param {any} value
 */
export function remember(key, value) {
  try {
    localStorage.setItem(key, JSON.stringify(value));
  } catch {
    // The page works without it.
  }
}

/** @type {Map<string, string>} */
const resolvedColors = new Map(); // until the colours change: to ask for one takes a layout of the page

/**
 * @param {string} name of a custom property, such as "--ink"
 * @returns {string} its present colour as rgb(...), for a canvas
 */
export function color(name) {
  const kept = resolvedColors.get(name);
  if (kept) return kept;
  const probe = document.createElement("i");
  probe.style.color = `var(${name})`;
  document.body.append(probe);
  const resolved = getComputedStyle(probe).color;
  probe.remove();
  resolvedColors.set(name, resolved);
  return resolved;
}

// The choice of the colours, with its button. What draws on a canvas listens to "vtb-theme" of the window.
export class Theme {
  constructor() {
    this.system = matchMedia("(prefers-color-scheme: dark)");
    this.system.addEventListener("change", () => this.#show());
    const choice = remembered(KEY);
    /** @type {Choice} */
    this.choice = CHOICES.includes(choice) ? choice : "system";
    this.button = button("vtb-theme", "", "", () => this.#choose());
    this.#show();
  }

  get isDark() {
    return this.choice === "dark" || (this.choice === "system" && this.system.matches);
  }

  #choose() {
    this.choice = CHOICES[(CHOICES.indexOf(this.choice) + 1) % CHOICES.length];
    remember(KEY, this.choice);
    this.#show();
  }

  #show() {
    document.documentElement.dataset.theme = this.choice;
    resolvedColors.clear();
    this.button.textContent = SIGNS[this.choice];
    const words = { system: "of the system", light: "light", dark: "dark" };
    this.button.title = `colours: ${words[this.choice]}`;
    this.button.setAttribute("aria-label", this.button.title);
    for (const [name, value] of Object.entries(BACKGROUND[this.isDark ? "dark" : "light"]))
      viewer.set_property(["Background", "<object>"], name, value);
    dispatchEvent(new Event("vtb-theme"));
  }
}

// The charts have the colours of the style sheet, in light and in dark, and a scale of colours for values.

import { color } from "./theme.js";

const VIRIDIS = [
  [68, 1, 84],
  [59, 82, 139],
  [33, 145, 140],
  [94, 201, 98],
  [253, 231, 37],
];

// The style sheet's custom properties, such as --ink, as a canvas takes them.
export const palette = {
  ink: "",
  soft: "",
  line: "",
  bad: "",
  card: "",
  best: "",
  broken: "",
  dropped: "",
  rim: "",
  pointed: "",
  tried: "",
  aim: "",
  driven: "",
};

// Before the charts are drawn again: their listeners are younger.
addEventListener("vtb-theme", () => {
  for (const name of /** @type {(keyof typeof palette)[]} */ (Object.keys(palette))) palette[name] = color(`--${name}`);
});

/**
 * @param {number} u from 0 to 1: bright is good
 * @param {number} [opacity]
 * @returns {string} the colour there; a grey for NaN
 */
export function shade(u, opacity = 1) {
  if (!Number.isFinite(u)) return palette.dropped;
  const place = Math.min(Math.max(u, 0), 1) * (VIRIDIS.length - 1);
  const k = Math.min(Math.floor(place), VIRIDIS.length - 2);
  const mix = VIRIDIS[k].map((a, i) => Math.round(a + (place - k) * (VIRIDIS[k + 1][i] - a)));
  return `rgba(${mix.join(",")},${opacity})`;
}

/** The scale of `shade` as an image of the style sheet, from left to right. */
export const GRADIENT = `linear-gradient(to right, ${VIRIDIS.map((rgb) => `rgb(${rgb.join(",")})`).join(", ")})`;

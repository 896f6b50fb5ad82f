// The symbols of the charts, and of their legend.

import { palette } from "./palette.js";

/**
 * Draws the symbol of a trial.
 *
 * @param {CanvasRenderingContext2D} pen
 * @param {number} x
 * @param {number} y
 * @param {number} size half the width, in pixels
 * @param {string} kind how the trial came out: "feasible", "broken", "dropped" or "failed"
 * @param {string} tint of a feasible one
 * @param {string} [style] "dot" for one of many, "framed" for one on a coloured ground
 */
export function point(pen, x, y, size, kind, tint, style = "") {
  if (kind === "failed") {
    pen.strokeStyle = palette.bad;
    pen.lineWidth = 1.5;
    pen.beginPath();
    pen.moveTo(x - size, y - size);
    pen.lineTo(x + size, y + size);
    pen.moveTo(x - size, y + size);
    pen.lineTo(x + size, y - size);
    pen.stroke();
    return;
  }
  if (style === "dot") {
    pen.fillStyle = kind === "broken" ? palette.broken : kind === "dropped" ? palette.dropped : tint;
    pen.fillRect(x - size, y - size, 2 * size, 2 * size);
    return;
  }
  pen.beginPath();
  if (kind === "dropped") {
    pen.moveTo(x - size, y - size);
    pen.lineTo(x + size, y - size);
    pen.lineTo(x, y + size);
    pen.closePath();
    pen.fillStyle = palette.dropped;
    pen.fill();
    return;
  }
  pen.arc(x, y, size, 0, 2 * Math.PI);
  if (kind === "broken") {
    pen.strokeStyle = palette.broken;
    pen.lineWidth = 1.5;
    pen.stroke();
    return;
  }
  pen.fillStyle = tint;
  pen.fill();
  pen.strokeStyle = style === "framed" ? "rgba(255,255,255,0.8)" : palette.rim;
  pen.lineWidth = 0.8;
  pen.stroke();
}

/**
 * Draws a ring around a symbol.
 *
 * @param {CanvasRenderingContext2D} pen
 * @param {number} x
 * @param {number} y
 * @param {number} size its radius, in pixels
 * @param {string} tint
 */
export function ring(pen, x, y, size, tint) {
  pen.strokeStyle = tint;
  pen.lineWidth = 2.5;
  pen.beginPath();
  pen.arc(x, y, size, 0, 2 * Math.PI);
  pen.stroke();
}

/**
 * Draws the mark of something that is no trial of the study.
 *
 * @param {CanvasRenderingContext2D} pen
 * @param {number} x
 * @param {number} y
 * @param {string} tint
 * @param {string} shape "cross", "diamond", "target" or "box"
 */
export function mark(pen, x, y, tint, shape) {
  pen.strokeStyle = tint;
  pen.lineWidth = 2;
  pen.beginPath();
  if (shape === "cross") {
    pen.moveTo(x - 9, y);
    pen.lineTo(x + 9, y);
    pen.moveTo(x, y - 9);
    pen.lineTo(x, y + 9);
  } else if (shape === "diamond") {
    pen.moveTo(x, y - 7);
    for (const [dx, dy] of [
      [6, 0],
      [0, 7],
      [-6, 0],
    ])
      pen.lineTo(x + dx, y + dy);
    pen.closePath();
    pen.fillStyle = palette.card;
    pen.fill();
  } else if (shape === "target") {
    pen.arc(x, y, 8, 0, 2 * Math.PI);
    pen.moveTo(x + 3, y);
    pen.arc(x, y, 3, 0, 2 * Math.PI);
  } else {
    pen.rect(x - 5, y - 5, 10, 10);
  }
  pen.stroke();
}

// The sheet of keys.

import { button, element } from "./common.js";

const KEYS = [
  ["space", "play or pause"],
  [".", "one step"],
  ["r", "begin again"],
  ["+  −", "faster, slower"],
  ["Esc", "cancel a preview, end the ghost of another course"],
  ["Ctrl z", "undo the last change"],
  ["/", "find a variable; arrows walk, Enter adds it"],
  ["m", "show or hide the panel"],
  ["f", "show all that moves"],
  ["1 2 3 4", "view from the corner, front, side, top"],
  ["← → ↓ ↑ a d s w j l k i", "drive by hand, once taken over"],
  ["?", "this sheet"],
];
const MOUSE = [
  ["drag", "turn the camera; with the right button or shift: move it; wheel: nearer, further"],
  ["drag in a plot", "zoom; double click: follow again"],
];

/**
 * @param {string[][]} rows
 * @returns {any} the rows as a table
 */
function table(rows) {
  return element(
    "table",
    {},
    ...rows.map(([keys, what]) =>
      element("tr", {}, element("th", { scope: "row" }, element("kbd", {}, keys)), element("td", {}, what)),
    ),
  );
}

export class KeySheet {
  constructor() {
    this.root = element(
      "dialog",
      { id: "vtb-keys", "aria-label": "keys", onclick: (/** @type {Event} */ event) => this.#click(event) },
      element("h2", {}, "Keys"),
      table(KEYS),
      element("h2", {}, "Mouse"),
      table(MOUSE),
      element(
        "p",
        {},
        button("", "close", "close (Esc)", () => this.root.close()),
      ),
    );
    document.body.append(this.root);
    this.button = button("vtb-help", "?", "keys (?)", () => this.root.showModal());
  }

  get isOpen() {
    return this.root.open;
  }

  // A click beside it closes it.
  /** @param {Event} event */
  #click(event) {
    if (event.target === this.root) this.root.close();
  }
}

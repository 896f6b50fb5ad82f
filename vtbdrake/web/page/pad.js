// A pad for a watched variable: an angle is a dial, the first two entries of a vector are the axes of a square.

import { element } from "./common.js";

// Returns whether a variable has a pad.
export const padded = ({ settable, shape, unit }) => settable && ((!shape.length && unit === "rad") || (shape.length === 1 && shape[0] >= 2));

export class Pad {
  constructor(watched) {
    this.watched = watched;
    this.isDial = !watched.variable.shape.length;
    this.knob = element("div", { className: "vtb-knob" });
    this.root = element(
      "div",
      {
        className: this.isDial ? "vtb-pad dial" : "vtb-pad",
        title: this.isDial ? "drag the angle; the release commits, Esc does nothing" : "drag the first two entries; the release commits, Esc does nothing",
        onpointerdown: (event) => this.#press(event),
        onpointermove: (event) => this.held && watched.preview(this.#changes(event)),
        onpointerup: (event) => this.#release(event),
        onpointercancel: () => this.#cancel(),
      },
      this.knob,
    );
  }

  #press(event) {
    event.preventDefault();
    document.activeElement?.blur(); // Esc is for the drag.
    this.root.setPointerCapture(event.pointerId);
    this.watched.draft = "none";
    this.held = true;
    this.watched.preview(this.#changes(event));
  }

  #release(event) {
    if (!this.held) return;
    this.held = false;
    this.watched.commit(this.#changes(event));
  }

  #cancel() {
    this.held = false;
    this.watched.page.cancel();
  }

  // Returns the entries at the pointer, by index, within their sliders.
  #changes({ clientX, clientY }) {
    const { left, top, width, height } = this.root.getBoundingClientRect();
    const x = Math.min(1, Math.max(0, (clientX - left) / width));
    const y = 1 - Math.min(1, Math.max(0, (clientY - top) / height));
    if (!this.isDial) {
      const changes = Object.fromEntries([x, y].map((share, index) => [index, this.#at(index, share)]));
      this.#place(x, y);
      return changes;
    }
    const { min, max } = this.watched.entries[0].slider;
    const turn = 2 * Math.PI;
    const angle = Math.atan2(y - 0.5, x - 0.5);
    const now = this.drafted ?? this.watched.values[0];
    this.drafted = Math.min(Number(max), Math.max(Number(min), angle + turn * Math.round((now - angle) / turn)));
    this.#turn(this.drafted);
    return { 0: this.drafted };
  }

  #at(index, share) {
    const { min, max } = this.watched.entries[index].slider;
    return Number(min) + share * (Number(max) - Number(min));
  }

  #place(x, y) {
    this.knob.style.left = `${100 * x}%`;
    this.knob.style.top = `${100 * (1 - y)}%`;
  }

  #turn(angle) {
    this.#place(0.5 + 0.42 * Math.cos(angle), 0.5 + 0.42 * Math.sin(angle));
  }

  // Shows the present values, unless they are being dragged.
  show() {
    if (this.held || this.watched.draft === "open") return;
    this.drafted = null;
    const { values, entries } = this.watched;
    if (this.isDial) return this.#turn(values[0]);
    const shares = [0, 1].map((index) => {
      const { min, max } = entries[index].slider;
      return (values[index] - min) / (max - min || 1);
    });
    this.#place(...shares);
  }
}

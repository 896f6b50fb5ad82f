// Drives the testbed by keyboard or gamepad: a key or a stick deflects an entry of a command u or of an actuator.

import { button, element, number } from "./common.js";

// What moves the first, the second, ... driven entry: two keys, and an axis of the gamepad with its sign.
const STICKS = [
  { keys: ["ArrowLeft", "ArrowRight"], label: "← →", axis: 0, sign: 1 },
  { keys: ["ArrowDown", "ArrowUp"], label: "↓ ↑", axis: 1, sign: -1 },
  { keys: ["a", "d"], label: "a d", axis: 2, sign: 1 },
  { keys: ["s", "w"], label: "s w", axis: 3, sign: -1 },
  { keys: ["j", "l"], label: "j l" },
  { keys: ["k", "i"], label: "k i" },
];
const DEAD_ZONE = 0.1; // of an axis
const STEPS = 50; // of a deflection, so that a trembling stick sends nothing
const POLL = 20; // ms between two looks at keys and gamepads
const BEAT = 200; // ms between two messages at most: without one for a second, the server takes this page for frozen
const FREEZE = 1000; // ms between two looks, after which a key may have been released unseen

export class Drive {
  /** @param {any} page */
  constructor(page) {
    this.page = page;
    /** @type {any[]} */
    this.rows = [];
    /** @type {any[]} */
    this.sticks = [];
    this.pressed = new Set();
    this.sent = "";
    this.sentAt = -Infinity;
    this.polledAt = -Infinity;
    this.driving = false;
    this.asked = 0; // the last command that began or ended a drive
    this.handles = element("div", {});
    this.status = element("output", { id: "vtb-drive-status" });
    this.begin = button("vtb-drive-begin", "take over", "drive by hand from now on, in a fork", () => this.#begin());
    this.keep = button("vtb-drive-keep", "keep", "end the drive, and go on from here", () => this.#end(true));
    this.drop = button("vtb-drive-drop", "drop", "end the drive, and go back to where it began", () =>
      this.#end(false),
    );
    this.root = element(
      "details",
      { id: "vtb-drive", hidden: true },
      element("summary", {}, "Drive by hand"),
      this.handles,
      element("p", { className: "vtb-buttons" }, this.begin, this.keep, this.drop),
      this.status,
    );
    // Keys of the drive come before keys of the page.
    document.addEventListener("keydown", (event) => this.#key(event, true), true);
    document.addEventListener("keyup", (event) => this.#key(event, false), true);
    for (const name of ["blur", "pagehide"]) addEventListener(name, () => this.#release());
    document.addEventListener("visibilitychange", () => document.hidden && this.#release());
    this.#show(null);
  }

  /** @param {{ handles: any[], quality: string }} message */
  hello({ handles, quality }) {
    this.quality = quality;
    this.root.hidden = !handles.length;
    this.rows = handles.map((handle) => {
      const drives = element("input", { type: "checkbox", onchange: () => this.#assign() });
      const returns = element("input", {
        type: "checkbox",
        disabled: !handle.bounded,
        checked: handle.bounded && handle.actuator,
      });
      const keys = element("small");
      const name = handle.address.replace(/^T_act\.(.*)\.idle$/, "$1 (actuator)");
      const row = element(
        "div",
        { className: "vtb-handle" },
        element("label", {}, drives, " ", name),
        keys,
        element("label", { title: "released keys let it return to where it began" }, returns, " returns"),
      );
      row.dataset.address = handle.address;
      return { ...handle, drives, returns, keys, row };
    });
    if (this.rows.length) this.rows[0].drives.checked = true;
    this.handles.replaceChildren(...this.rows.map(({ row }) => row));
    this.#assign();
  }

  // Gives the entries of what is checked their keys, in order.
  #assign() {
    this.sticks = [];
    for (const row of this.rows) {
      row.slots = [];
      if (row.drives.checked) {
        for (let entry = 0; entry < row.size; entry += 1) {
          const stick = STICKS[this.sticks.length];
          if (stick) this.sticks.push({ ...stick, address: row.address, entry, size: row.size });
          row.slots.push(stick ? stick.label : "no key");
        }
      }
      const more = row.slots.length > 2 ? ", ..." : "";
      row.keys.textContent = row.slots.slice(0, 2).join(", ") + more;
      row.keys.title = row.slots.join(", ");
    }
    this.begin.disabled = !this.sticks.length;
  }

  async #begin() {
    const driven = this.rows.filter((row) => row.drives.checked);
    const returning = driven.filter((row) => row.returns.checked).map(({ address }) => address);
    const compare = this.page.compare.checked;
    this.begin.blur();
    this.sent = "";
    this.pressed.clear();
    const addresses = driven.map(({ address }) => address);
    const asked = this.page.ask("drive", { addresses, returning, compare });
    this.asked = this.page.session.asked;
    const begun = await asked;
    if (!begun) return;
    this.#follow();
    await this.page.ask("play");
  }

  /** @param {boolean} keep */
  async #end(keep) {
    /** @type {HTMLElement | null} */ (document.activeElement)?.blur();
    const asked = this.page.ask("end_drive", { keep });
    this.asked = this.page.session.asked;
    const driven = await asked;
    if (!driven) return;
    const value =
      driven.value === null ? "" : `, ${this.quality} ${number(driven.value)} at t* = ${number(driven.t_star)} s`;
    this.page.say(`driven for ${driven.seconds.toFixed(2)} s (${driven.end})${value}`, driven.failed ? "bad" : "draft");
  }

  /**
   * @param {KeyboardEvent} event
   * @param {boolean} down
   */
  #key(event, down) {
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (!down) this.pressed.delete(key);
    if (!this.driving || event.ctrlKey || event.metaKey || event.altKey) return;
    if (/** @type {Element} */ (event.target).matches?.("input[type=text], input[type=search], select")) return;
    if (!this.sticks.some(({ keys }) => keys.includes(key))) return;
    event.preventDefault();
    event.stopImmediatePropagation();
    if (down) this.pressed.add(key);
    this.#send();
  }

  #release() {
    this.pressed.clear();
    this.#send();
  }

  // Sends the deflections, if they have changed, and otherwise now and then: who drives holds a dead man's handle.
  #send() {
    if (!this.driving) return;
    const pads = document.hasFocus() ? [...navigator.getGamepads()].filter((pad) => pad?.connected) : [];
    /** @type {Record<string, number[]>} */
    const deflections = {};
    for (const { keys, axis, sign, address, entry, size } of this.sticks) {
      let deflection = Number(this.pressed.has(keys[1])) - Number(this.pressed.has(keys[0]));
      for (const pad of pads) {
        const value = sign * (pad?.axes[axis] ?? 0);
        if (Math.abs(value) > DEAD_ZONE) deflection += value;
      }
      deflections[address] ??= Array(size).fill(0);
      deflections[address][entry] = Math.round(STEPS * Math.max(-1, Math.min(1, deflection))) / STEPS;
    }
    const text = JSON.stringify(deflections);
    const now = performance.now();
    if (text === this.sent && now - this.sentAt < BEAT) return;
    this.sent = text;
    this.sentAt = now;
    this.page.ask("deflect", { deflections }, "deflect");
  }

  /** @param {{ drive: any, steers: boolean }} frame */
  frame({ drive, steers }) {
    if (!this.page.reflects(this.asked)) return;
    if (!drive || !steers) this.driving = false;
    else this.#follow();
    this.#show(drive);
  }

  #follow() {
    if (this.driving) return;
    this.driving = true;
    this.polledAt = performance.now();
    this.#poll();
  }

  // A gamepad has no events of its axes.
  #poll() {
    if (!this.driving) return;
    const now = performance.now();
    if (now - this.polledAt > FREEZE) this.pressed.clear(); // A key that is still held repeats.
    this.polledAt = now;
    this.#send();
    setTimeout(() => this.#poll(), POLL);
  }

  /** @param {any} drive */
  #show(drive) {
    this.begin.hidden = Boolean(drive);
    this.keep.hidden = this.drop.hidden = !drive;
    for (const { drives, returns, bounded } of this.rows) {
      drives.disabled = Boolean(drive);
      returns.disabled = Boolean(drive) || !bounded;
    }
    document.body.classList.toggle("vtb-driving", Boolean(drive));
    if (drive?.notice) this.page.say(`${drive.notice}: the sticks are released, and time stands still`, "bad", "drive");
    else this.page.takeBack("drive");
    if (!drive) {
      this.status.textContent = "";
      return;
    }
    const values = Object.entries(drive.values).map(
      (/** @type {[string, any]} */ [address, entries]) =>
        `${address.replace(/^T_act\.(.*)\.idle$/, "$1")}  ${entries
          .slice(0, 4)
          .map((/** @type {number} */ v) => v.toFixed(3))
          .join("  ")}`,
    );
    const f = drive.value === null ? [] : [`${this.quality}${drive.ended ? "" : " now"}  ${number(drive.value)}`];
    this.status.textContent = [
      `driven for ${drive.seconds.toFixed(2)} s`,
      ...values,
      ...f,
      ...(drive.ended ? [`ended: ${drive.ended}`] : []),
    ].join("\n");
    if (this.root.open === false) this.root.open = true;
  }
}

// What is dragged to set several numbers at once: a dial or a pad in the panel, and a handle in the scene.

import { element } from "./common.js";

const TURN = 2 * Math.PI;
const EDGE_ON = 0.03; // sine of the angle between a ray and a plane, below which the plane is not dragged along

/**
 * A watched variable, as far as its draggable parts use it.
 *
 * @typedef {import("./watched.js").Watched} Watched
 */

/**
 * @param {{ shape: number[] }} variable
 * @param {number} least size
 */
const isVector = ({ shape }, least) => shape.length === 1 && shape[0] >= least;

/**
 * @param {Watched} watched
 * @returns {(Pad | Handle)[]} its parts that can be dragged
 */
export function draggables(watched) {
  const { settable, shape, unit, kind } = watched.variable;
  if (!settable) return [];
  // A state or a command: centres of mass and mountings, which are parameters, are seen from a body.
  const isPlace =
    kind === "x" &&
    ((unit === "m" && isVector(watched.variable, 2) && shape[0] <= 3) ||
      (watched.address.endsWith(".pose") && shape[0] === 6));
  return [
    ...(!shape.length && unit === "rad" ? [new Dial(watched)] : []),
    ...(isVector(watched.variable, 2) ? [new Pad(watched)] : []),
    ...(isPlace ? [new Handle(watched)] : []),
  ];
}

// A drag is a draft; the release commits, Esc does nothing. A subclass has `changes` and `place`.
class Draggable {
  held = false;

  /**
   * @param {Watched} watched
   * @param {string} className
   * @param {string} title
   */
  constructor(watched, className, title) {
    this.watched = watched;
    this.root = element("div", {
      className,
      title: `drag ${title}; the release commits, Esc does nothing`,
      onpointerdown: (/** @type {PointerEvent} */ event) => this.#press(event),
      onpointermove: (/** @type {PointerEvent} */ event) => this.#isDragged && watched.preview(this.changes(event)),
      onpointerup: (/** @type {PointerEvent} */ event) => this.#release(event),
      onpointercancel: () => this.#cancel(),
    });
  }

  /** @param {PointerEvent} event */
  #press(event) {
    if (event.button !== 0 || !this.watched.values.length) return; // Its place is not known yet.
    event.preventDefault();
    /** @type {HTMLElement | null} */ (document.activeElement)?.blur(); // Esc is for the drag.
    this.root.setPointerCapture(event.pointerId);
    this.watched.draft = "none";
    this.held = true;
    this.watched.preview(this.changes(event));
  }

  /** @param {PointerEvent} event */
  #release(event) {
    if (!this.held) return;
    const changes = this.#isDragged ? this.changes(event) : {};
    this.held = false;
    this.watched.commit(changes);
  }

  #cancel() {
    this.held = false;
    this.watched.page.cancel();
  }

  // Esc ends a drag before the release.
  get #isDragged() {
    return this.held && this.watched.draft !== "cancelled";
  }

  /**
   * @abstract
   * @param {PointerEvent} _event
   * @returns {Record<number, number>} the entries at the pointer, by index
   */
  changes(_event) {
    throw new Error("a draggable part has its own changes");
  }

  /**
   * @abstract
   * @param {number[]} _values shows them
   */
  place(_values) {
    throw new Error("a draggable part has its own place");
  }

  /**
   * Shows the values of the variable, present or drafted elsewhere, unless it is being dragged itself.
   *
   * @param {number[]} values
   */
  show(values) {
    if (!this.#isDragged) this.place(values);
  }

  remove() {
    this.root.remove();
  }
}

class Pad extends Draggable {
  /**
   * @param {Watched} watched
   * @param {string} className
   * @param {string} title
   */
  constructor(watched, className = "vtb-pad", title = "the first two entries") {
    super(watched, className, title);
    this.knob = element("div", { className: "vtb-knob" });
    this.root.append(this.knob);
  }

  /**
   * @param {PointerEvent} event
   * @returns {number[]} where the pointer is, across and up, each from 0 to 1
   */
  shares({ clientX, clientY }) {
    const { left, top, width, height } = this.root.getBoundingClientRect();
    return [(clientX - left) / width, 1 - (clientY - top) / height].map((share) => Math.min(1, Math.max(0, share)));
  }

  /** @param {PointerEvent} event */
  changes(event) {
    const shares = this.shares(event);
    this.put(shares[0], shares[1]);
    return Object.fromEntries(
      shares.map((share, index) => {
        const { min, max } = this.watched.entries[index].slider;
        return [index, Number(min) + share * (Number(max) - Number(min))];
      }),
    );
  }

  /**
   * @param {number} x from 0 to 1
   * @param {number} y from 0 to 1, upwards
   */
  put(x, y) {
    this.knob.style.left = `${100 * x}%`;
    this.knob.style.top = `${100 * (1 - y)}%`;
  }

  /** @param {number[]} values */
  place(values) {
    const { entries } = this.watched;
    const [x, y] = [0, 1].map((index) => {
      const { min, max } = entries[index].slider;
      return (values[index] - min) / (max - min || 1);
    });
    this.put(x, y);
  }
}

class Dial extends Pad {
  /** @type {number | null} */
  drafted = null;

  /** @param {Watched} watched */
  constructor(watched) {
    super(watched, "vtb-pad dial", "the angle");
  }

  /** @param {PointerEvent} event */
  changes(event) {
    const [x, y] = this.shares(event);
    const { min, max } = this.watched.entries[0].slider;
    const angle = Math.atan2(y - 0.5, x - 0.5);
    const now = this.drafted ?? this.watched.values[0];
    this.drafted = Math.min(Number(max), Math.max(Number(min), angle + TURN * Math.round((now - angle) / TURN)));
    this.#turn(this.drafted);
    /** @type {Record<number, number>} */
    const changes = { 0: this.drafted };
    return changes;
  }

  /** @param {number} angle */
  #turn(angle) {
    this.put(0.5 + 0.42 * Math.cos(angle), 0.5 + 0.42 * Math.sin(angle));
  }

  /** @param {number[]} values */
  place([angle]) {
    this.drafted = null;
    this.#turn(angle);
  }
}

// A handle over the scene, where the first entries of a variable are in the world; variables of a plane lie on the
// ground. It moves level, and up and down with shift. Meshcat's world has y up: (x, y, z) is drawn at (x, z, -y).
class Handle extends Draggable {
  /** @type {number[] | null} */
  at = null; // its place in Drake's world

  /** @param {Watched} watched */
  constructor(watched) {
    super(watched, "vtb-place", `${watched.address} in the scene (with shift: up and down)`);
    this.root.dataset.address = watched.address;
    this.isSpatial = watched.variable.shape[0] > 2;
    this.root.hidden = true; // until its place is known
    document.body.append(this.root);
    this.#follow();
  }

  /** @param {number[]} values */
  place([x, y, z]) {
    this.at = [x, y, this.isSpatial ? z : 0];
  }

  /** @param {PointerEvent} event */
  changes(event) {
    const [x, y, z] = this.#aimed(event);
    const [lower, upper] = this.watched.variable.bounds;
    const within = (/** @type {number} */ value, /** @type {number} */ index) =>
      Math.min(upper[index] ?? Infinity, Math.max(lower[index] ?? -Infinity, value));
    const at = [within(x, 0), within(y, 1), this.isSpatial ? within(z, 2) : 0];
    this.at = at;
    return Object.fromEntries((this.isSpatial ? at : at.slice(0, 2)).map((value, index) => [index, value]));
  }

  /**
   * Where the ray through the pointer meets the level plane through the handle; with shift, its height over the place.
   *
   * @param {PointerEvent} event
   * @returns {number[]} in Drake's world
   */
  #aimed({ clientX, clientY, shiftKey }) {
    const { left, top, width, height } = viewer.renderer.domElement.getBoundingClientRect();
    const pointer = [(2 * (clientX - left)) / width - 1, 1 - (2 * (clientY - top)) / height];
    const [near, far] = [-1, 1].map((depth) => this.#point([...pointer, depth]).unproject(viewer.camera));
    const start = [near.x, -near.z, near.y];
    const ray = [far.x - near.x, near.z - far.z, far.y - near.y];
    const at = this.at ?? [0, 0, 0];
    const [x, y, z] = at;
    const length = Math.hypot(...ray);
    if (shiftKey && this.isSpatial) {
      // In the upright plane through the handle that faces the camera.
      const across = ray[0] ** 2 + ray[1] ** 2;
      if (Math.sqrt(across) < EDGE_ON * length) return at;
      const share = ((x - start[0]) * ray[0] + (y - start[1]) * ray[1]) / across;
      return [x, y, start[2] + share * ray[2]];
    }
    const share = (z - start[2]) / ray[2];
    if (Math.abs(ray[2]) < EDGE_ON * length || !(share > 0 && share < 1)) return at;
    return [start[0] + share * ray[0], start[1] + share * ray[1], z];
  }

  /**
   * @param {number[]} place
   * @returns {any} a vector of three.js
   */
  #point(place) {
    return viewer.camera.position.clone().set(...place);
  }

  // Called in each animation frame: the camera may move.
  #follow() {
    if (!this.root.isConnected) return;
    requestAnimationFrame(() => this.#follow());
    if (!this.at) return;
    const { left, top, width, height } = viewer.renderer.domElement.getBoundingClientRect();
    const [x, y, z] = this.at;
    const point = this.#point([x, z, -y]).project(viewer.camera);
    const isSeen = Math.abs(point.x) <= 1 && Math.abs(point.y) <= 1 && Math.abs(point.z) <= 1;
    this.root.hidden = !isSeen || !this.at.every(Number.isFinite); // What is not known is nowhere.
    const [across, down] = [left + 0.5 * (1 + point.x) * width, top + 0.5 * (1 - point.y) * height];
    this.root.style.transform = `translate(${across}px, ${down}px)`;
  }
}

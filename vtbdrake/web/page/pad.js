// What is dragged to set several numbers at once: a dial or a pad in the panel, and a handle in the scene.

import { element } from "./common.js";

const TURN = 2 * Math.PI;
const EDGE_ON = 0.03; // sine of the angle between a ray and a plane, below which the plane is not dragged along

const isVector = ({ shape }, least) => shape.length === 1 && shape[0] >= least;

// Returns the parts of a watched variable that can be dragged.
export function draggables(watched) {
  const { settable, shape, unit, kind } = watched.variable;
  if (!settable) return [];
  // A state or a command: centres of mass and mountings, which are parameters, are seen from a body.
  const isPlace = kind === "x" && ((unit === "m" && isVector(watched.variable, 2) && shape[0] <= 3) || (watched.address.endsWith(".pose") && shape[0] === 6));
  return [
    ...(!shape.length && unit === "rad" ? [new Dial(watched)] : []),
    ...(isVector(watched.variable, 2) ? [new Pad(watched)] : []),
    ...(isPlace ? [new Handle(watched)] : []),
  ];
}

// A drag is a draft; the release commits, Esc does nothing. A subclass has `changes`, the entries at the pointer by index.
class Draggable {
  constructor(watched, className, title) {
    this.watched = watched;
    this.root = element("div", {
      className,
      title: `drag ${title}; the release commits, Esc does nothing`,
      onpointerdown: (event) => this.#press(event),
      onpointermove: (event) => this.#isDragged && watched.preview(this.changes(event)),
      onpointerup: (event) => this.#release(event),
      onpointercancel: () => this.#cancel(),
    });
  }

  #press(event) {
    if (event.button !== 0) return;
    event.preventDefault();
    document.activeElement?.blur(); // Esc is for the drag.
    this.root.setPointerCapture(event.pointerId);
    this.watched.draft = "none";
    this.held = true;
    this.watched.preview(this.changes(event));
  }

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

  // Shows the values of the variable, present or drafted elsewhere, unless it is being dragged itself.
  show(values) {
    if (!this.#isDragged) this.place(values);
  }

  remove() {
    this.root.remove();
  }
}

class Pad extends Draggable {
  constructor(watched, className = "vtb-pad", title = "the first two entries") {
    super(watched, className, title);
    this.knob = element("div", { className: "vtb-knob" });
    this.root.append(this.knob);
  }

  // Returns where the pointer is, each from 0 to 1.
  shares({ clientX, clientY }) {
    const { left, top, width, height } = this.root.getBoundingClientRect();
    return [(clientX - left) / width, 1 - (clientY - top) / height].map((share) => Math.min(1, Math.max(0, share)));
  }

  changes(event) {
    const shares = this.shares(event);
    this.put(...shares);
    return Object.fromEntries(
      shares.map((share, index) => {
        const { min, max } = this.watched.entries[index].slider;
        return [index, Number(min) + share * (Number(max) - Number(min))];
      }),
    );
  }

  put(x, y) {
    this.knob.style.left = `${100 * x}%`;
    this.knob.style.top = `${100 * (1 - y)}%`;
  }

  place(values) {
    const { entries } = this.watched;
    this.put(
      ...[0, 1].map((index) => {
        const { min, max } = entries[index].slider;
        return (values[index] - min) / (max - min || 1);
      }),
    );
  }
}

class Dial extends Pad {
  constructor(watched) {
    super(watched, "vtb-pad dial", "the angle");
  }

  changes(event) {
    const [x, y] = this.shares(event);
    const { min, max } = this.watched.entries[0].slider;
    const angle = Math.atan2(y - 0.5, x - 0.5);
    const now = this.drafted ?? this.watched.values[0];
    this.drafted = Math.min(Number(max), Math.max(Number(min), angle + TURN * Math.round((now - angle) / TURN)));
    this.#turn(this.drafted);
    return { 0: this.drafted };
  }

  #turn(angle) {
    this.put(0.5 + 0.42 * Math.cos(angle), 0.5 + 0.42 * Math.sin(angle));
  }

  place([angle]) {
    this.drafted = null;
    this.#turn(angle);
  }
}

// A handle over the scene, where the first entries of a variable are in the world; those of a plane lie on the ground.
// It moves level, and up and down with shift. Meshcat's world has y up: (x, y, z) is drawn at (x, z, -y).
class Handle extends Draggable {
  constructor(watched) {
    super(watched, "vtb-place", `${watched.address} in the scene (with shift: up and down)`);
    this.root.dataset.address = watched.address;
    this.isSpatial = watched.variable.shape[0] > 2;
    this.root.hidden = true; // until its place is known
    document.body.append(this.root);
    this.#follow();
  }

  place([x, y, z]) {
    this.at = [x, y, this.isSpatial ? z : 0];
  }

  changes(event) {
    const [x, y, z] = this.#aimed(event);
    const [lower, upper] = this.watched.variable.bounds;
    const within = (value, index) => Math.min(upper[index] ?? Infinity, Math.max(lower[index] ?? -Infinity, value));
    this.at = [within(x, 0), within(y, 1), this.isSpatial ? within(z, 2) : 0];
    return Object.fromEntries((this.isSpatial ? this.at : this.at.slice(0, 2)).map((value, index) => [index, value]));
  }

  // Where the ray through the pointer meets the level plane through the handle; with shift, its height over the place.
  #aimed({ clientX, clientY, shiftKey }) {
    const { left, top, width, height } = viewer.renderer.domElement.getBoundingClientRect();
    const pointer = [(2 * (clientX - left)) / width - 1, 1 - (2 * (clientY - top)) / height];
    const [near, far] = [-1, 1].map((depth) => this.#point(...pointer, depth).unproject(viewer.camera));
    const start = [near.x, -near.z, near.y];
    const ray = [far.x - near.x, near.z - far.z, far.y - near.y];
    const [x, y, z] = this.at;
    const length = Math.hypot(...ray);
    if (shiftKey && this.isSpatial) {
      // In the upright plane through the handle that faces the camera.
      const across = ray[0] ** 2 + ray[1] ** 2;
      if (Math.sqrt(across) < EDGE_ON * length) return this.at;
      const share = ((x - start[0]) * ray[0] + (y - start[1]) * ray[1]) / across;
      return [x, y, start[2] + share * ray[2]];
    }
    const share = (z - start[2]) / ray[2];
    if (Math.abs(ray[2]) < EDGE_ON * length || !(share > 0 && share < 1)) return this.at;
    return [start[0] + share * ray[0], start[1] + share * ray[1], z];
  }

  #point(...place) {
    return viewer.camera.position.clone().set(...place);
  }

  // Called in each animation frame: the camera may move.
  #follow() {
    if (!this.root.isConnected) return;
    requestAnimationFrame(() => this.#follow());
    if (!this.at) return;
    const { left, top, width, height } = viewer.renderer.domElement.getBoundingClientRect();
    const [x, y, z] = this.at;
    const point = this.#point(x, z, -y).project(viewer.camera);
    const isSeen = Math.abs(point.x) <= 1 && Math.abs(point.y) <= 1 && Math.abs(point.z) <= 1;
    this.root.hidden = !isSeen || !this.at.every(Number.isFinite); // What is not known is nowhere.
    this.root.style.transform = `translate(${left + 0.5 * (1 + point.x) * width}px, ${top + 0.5 * (1 - point.y) * height}px)`;
  }
}

// The camera of the scene: what it follows, a view of all that moves, and views along the axes.

import { button, element } from "./common.js";

// From where the scene is seen, in Drake's world (z up): from there to the middle of what moves.
const VIEWS = {
  corner: { from: [1, -1, 0.7], key: "1" },
  front: { from: [1, 0, 0], key: "2" },
  side: { from: [0, -1, 0], key: "3" },
  top: { from: [0, -1e-3, 1], key: "4" }, // Exactly from above, the camera would not know where up is.
};
const PICTURE = 0.8; // least width by height of a picture that shows all from where the server puts the camera
const AIR = 1.15; // how much wider than what moves a view is

export class Camera {
  /** @type {string[]} */
  bodies = [];
  /** @type {string | undefined} */
  followed = undefined; // what was followed in the last animation frame
  place = [0, 0, 0]; // where it was, in three.js's world
  isWidened = false;

  constructor() {
    this.follow = element(
      "select",
      { id: "vtb-follow", onchange: () => this.follow.blur() },
      element("option", { value: "" }, "nothing"),
    );
    this.root = element("div", {}, element("h2", {}, "Camera"), element("label", {}, "follows ", this.follow));
    this.toolbar = element(
      "div",
      { id: "vtb-views", role: "toolbar", "aria-label": "camera" },
      button("vtb-fit", "fit", "show all that moves (f)", () => this.fit()),
      ...Object.entries(VIEWS).map(([name, { key }]) =>
        button(`vtb-view-${name}`, name, `view from the ${name} (${key})`, () => this.look(name)),
      ),
    );
    document.body.append(this.toolbar);
    // Keys of the page, with what they do.
    this.keys = {
      f: () => this.fit(),
      ...Object.fromEntries(Object.entries(VIEWS).map(([name, { key }]) => [key, () => this.look(name)])),
    };
  }

  /**
   * @param {string[]} bodies paths of what moves
   * @param {string} followed the one that is followed at first, or nothing
   */
  hello(bodies, followed) {
    this.bodies = bodies;
    this.follow.append(...bodies.map((path) => element("option", { value: path }, path.replace(/^now\//, ""))));
    this.follow.value = followed;
    this.followed = undefined;
  }

  // Shows all that moves, from where the camera is.
  fit() {
    const { camera, controls } = viewer;
    this.#see(camera.position.clone().sub(controls.target));
  }

  /** @param {string} name of a view */
  look(name) {
    const [x, y, z] = VIEWS[/** @type {keyof typeof VIEWS} */ (name)].from;
    this.#see(viewer.camera.position.clone().set(x, z, -y));
  }

  /** @param {any} direction from the middle of what moves to the camera, a vector of three.js */
  #see(direction) {
    const { camera, controls } = viewer;
    const [middle, radius] = this.#extent();
    const narrow = Math.min(1, camera.aspect || 1); // In an upright picture, the width is the limit.
    const angle = Math.atan(narrow * Math.tan((0.5 * (camera.fov || 60) * Math.PI) / 180));
    controls.target.copy(middle);
    camera.position.copy(middle).add(direction.setLength((AIR * radius) / Math.sin(angle)));
    controls.update();
    viewer.set_dirty();
  }

  /** @returns {[any, number]} the middle of what moves, or of the camera's view without it, and its radius */
  #extent() {
    const { camera, controls } = viewer;
    /** @type {any} */
    let box = null;
    for (const path of this.bodies) {
      viewer.scene_tree.find(["drake", ...path.split("/")]).object.traverse((/** @type {any} */ part) => {
        if (!part.geometry) return;
        part.geometry.computeBoundingBox();
        const own = part.geometry.boundingBox.clone().applyMatrix4(part.matrixWorld);
        box = box ? box.union(own) : own;
      });
    }
    if (!box || box.isEmpty()) return [controls.target.clone(), 0.5 * camera.position.distanceTo(controls.target)];
    const middle = box.min.clone().add(box.max).multiplyScalar(0.5);
    return [middle, Math.max(0.5 * box.min.distanceTo(box.max), 0.01)];
  }

  // An upright picture is seen from further away than where the server puts the camera.
  #widen() {
    const { camera, controls } = viewer;
    const isPut = camera.position.distanceTo(controls.target) > 0 && this.bodies.length;
    if (this.isWidened || !isPut || controls.target.lengthSq() + camera.position.x ** 2 === 0) return;
    this.isWidened = true;
    const further = PICTURE / camera.aspect;
    if (further > 1) camera.position.sub(controls.target).multiplyScalar(further).add(controls.target);
    viewer.set_dirty();
  }

  // Called in each animation frame: what it follows keeps its place in the picture.
  followBody() {
    requestAnimationFrame(() => this.followBody());
    this.#widen();
    const name = this.follow.value;
    if (name) {
      const { object } = viewer.scene_tree.find(["drake", ...name.split("/")]);
      const place = object.matrixWorld.elements.slice(12, 15);
      const { camera, controls } = viewer;
      if (this.followed === undefined) {
        if (!place.some(Boolean)) return; // It has not been placed yet.
        const middle = controls.target.toArray();
        const away = Math.hypot(
          ...place.map((/** @type {number} */ value, /** @type {number} */ i) => value - middle[i]),
        );
        // The camera was put where the robot began, which may have walked away since.
        this.place = away > 0.3 * camera.position.distanceTo(controls.target) ? middle : place;
        this.followed = name;
      }
      if (this.followed === name) {
        const [x, y, z] = place.map((/** @type {number} */ value, /** @type {number} */ i) => value - this.place[i]);
        for (const point of [camera.position, controls.target]) {
          point.x += x;
          point.y += y;
          point.z += z;
        }
        if (x || y || z) viewer.set_dirty(); // The viewer draws for messages only.
      }
      this.place = place;
    }
    this.followed = name;
  }
}

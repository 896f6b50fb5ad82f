// The layers of a session: their toggles, the images of cameras, and names in the scene.

import { element } from "./common.js";

const IMAGE_PERIOD = 200; // ms between two images of a camera
const LANDMARKS_PERIOD = 500; // ms between two lists of landmarks
const [LETTER, LINE] = [6, 15]; // px, of names
const LANDMARKS = 40; // that are named, the nearest to where the camera looks

// What is drawn of these is seen through bodies and ground.
const ON_TOP = [["perceived", "covariance"], ["landmarks"]];

export class Layers {
  /** @param {any} page */
  constructor(page) {
    this.page = page;
    /** @type {Record<string, string>} */
    this.titles = {};
    /** @type {string[]} */
    this.bodies = [];
    /** @type {Map<string, { box: any, note: any }>} */
    this.toggles = new Map();
    this.labels = new Map(); // name -> element
    /** @type {[string, number[]][]} */
    this.landmarks = []; // of [name, [x, y, z]], in the world
    this.images = element("div", { id: "vtb-images" });
    this.names = element("div", { id: "vtb-names" });
    this.root = element("div", { id: "vtb-layers" }, element("h2", {}, "Layers"));
  }

  /** @param {{ layers: Record<string, string>, cameras: string[], bodies: string[] }} message */
  hello({ layers, cameras, bodies }) {
    this.titles = layers;
    this.bodies = bodies;
    document.body.append(this.images, this.names);
    for (const [name, title] of Object.entries(layers)) this.#add(name, title, () => this.#show());
    if (bodies.length) this.#add("names", "names of bodies", () => {});
    for (const camera of cameras)
      this.#add(`image-${camera}`, `image of ${camera}`, (shown) => this.#showImage(camera, shown));
    this.#nameObjects();
    this.#askForLandmarks();
  }

  /**
   * @param {string} name
   * @param {string} title
   * @param {(shown: boolean) => void} changed
   */
  #add(name, title, changed) {
    const box = element("input", {
      type: "checkbox",
      id: `vtb-layer-${name}`,
      onchange: () => {
        changed(box.checked);
        this.page.keepLayout();
      },
    });
    const note = element("small");
    this.toggles.set(name, { box, note });
    this.root.append(element("div", {}, element("label", {}, box, ` ${title}`), note));
  }

  /** @returns {string[]} what is shown, by name */
  shown() {
    return [...this.toggles].filter(([, { box }]) => box.checked).map(([name]) => name);
  }

  /** @param {string[]} names what is shown again, as far as there still is such a layer */
  restore(names) {
    for (const name of names) this.toggles.get(name)?.box.click();
  }

  /** @param {string} name */
  isOn(name) {
    return this.toggles.get(name)?.box.checked ?? false;
  }

  #show() {
    const shown = Object.keys(this.titles).filter((name) => this.isOn(name));
    this.page.ask("layers", { layers: shown });
  }

  /**
   * What there is to say about each layer; another page may show layers that are hidden in this one.
   *
   * @param {{ layers: Record<string, string> }} frame
   */
  frame({ layers }) {
    for (const name of Object.keys(this.titles)) {
      const { box, note } = /** @type {{ box: any, note: any }} */ (this.toggles.get(name));
      note.textContent = box.checked ? (layers[name] ?? "") : "";
      const node = this.#node([name]);
      if (!node || node.object.visible === box.checked) continue;
      node.object.visible = box.checked;
      viewer.set_dirty();
    }
    for (const path of ON_TOP) {
      this.#node(path)?.object.traverse((/** @type {any} */ { material }) => {
        if (!material?.depthTest) return;
        material.depthTest = false;
        viewer.set_dirty();
      });
    }
  }

  /** @param {string[]} path */
  #node(path) {
    return ["drake", "layers", ...path].reduce((node, name) => node?.children[name], viewer.scene_tree);
  }

  // -- images

  /**
   * @param {string} camera
   * @param {boolean} shown
   */
  #showImage(camera, shown) {
    const id = `vtb-image-${camera}`;
    document.getElementById(id)?.remove();
    if (!shown) return;
    const image = element("img", { alt: `image of ${camera}` });
    const figure = element("figure", { id }, image, element("figcaption", {}, camera));
    this.images.append(figure);
    this.#showImages(camera, figure, image);
  }

  /**
   * The next image is asked for when the last one is shown: a slow browser gets fewer.
   *
   * @param {string} camera
   * @param {any} figure
   * @param {HTMLImageElement} image
   */
  async #showImages(camera, figure, image) {
    while (figure.isConnected) {
      if (!document.hidden) {
        const answer = await fetch(`camera/${encodeURIComponent(camera)}`).catch(() => null);
        const coming = answer?.ok ? answer.blob() : answer?.text();
        const content = await /** @type {Promise<string | Blob | null>} */ (coming)?.catch(() => null);
        if (typeof content !== "string" && !(content instanceof Blob)) {
          figure.lastChild.textContent = `${camera}: the server does not answer`;
          return;
        }
        if (content instanceof Blob) {
          const url = URL.createObjectURL(content);
          image.src = url;
          await image.decode().catch(() => {});
          URL.revokeObjectURL(url);
          figure.dataset.images = Number(figure.dataset.images ?? 0) + 1;
        }
        figure.lastChild.textContent = content instanceof Blob ? camera : `${camera}: ${content}`;
      }
      await new Promise((resolve) => setTimeout(resolve, IMAGE_PERIOD));
    }
  }

  // -- names

  async #askForLandmarks() {
    if (this.isOn("landmarks") && !document.hidden) {
      const { x, y, z } = viewer.controls.target;
      const landmarks = await this.page.ask("landmarks", { near: [x, -z, y], count: LANDMARKS }, "landmarks");
      if (landmarks) this.page.takeBack("landmarks");
      this.landmarks = landmarks ?? [];
    } else {
      this.landmarks = [];
    }
    setTimeout(() => this.#askForLandmarks(), LANDMARKS_PERIOD);
  }

  // Called in each animation frame. Meshcat's world has y up: (x, y, z) is drawn at (x, z, -y).
  #nameObjects() {
    const places = this.landmarks.map(([name, [x, y, z]]) => [`landmark ${name}`, name, [x, z, -y]]);
    if (this.isOn("names")) {
      for (const path of this.bodies) {
        const { object } = viewer.scene_tree.find(["drake", ...path.split("/")]);
        places.push([path, path.split("/").at(-1), object.matrixWorld.elements.slice(12, 15)]);
      }
    }
    const shown = new Set(places.map(([key]) => key));
    for (const [key, label] of this.labels) {
      if (shown.has(key)) continue;
      label.remove();
      this.labels.delete(key);
    }
    const { left, top, width, height } = viewer.renderer.domElement.getBoundingClientRect();
    const points = places.map(([key, name, place]) => [
      key,
      name,
      viewer.camera.position
        .clone()
        .set(...place)
        .project(viewer.camera),
    ]);
    const taken = []; // of the names that are nearer
    for (const [key, name, point] of points.sort(([, , a], [, , b]) => a.z - b.z)) {
      let label = this.labels.get(key);
      if (!label) {
        label = element("span", {}, name);
        label.dataset.name = key;
        this.labels.set(key, label);
        this.names.append(label);
      }
      const [x, y] = [left + 0.5 * (1 + point.x) * width, top + 0.5 * (1 - point.y) * height];
      const reach = LETTER * name.length + 6;
      const covered = taken.some(
        (other) => Math.abs(other.y - y) < LINE && x < other.x + other.reach && other.x < x + reach,
      );
      label.hidden = covered || Math.abs(point.x) > 1 || Math.abs(point.y) > 1 || point.z > 1;
      if (label.hidden) continue;
      taken.push({ x, y, reach });
      label.style.transform = `translate(${x}px, ${y}px)`;
    }
    requestAnimationFrame(() => this.#nameObjects());
  }
}

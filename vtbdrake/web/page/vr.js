// A headset leads the robot: what it tracks is sent to the server, which decides what becomes of it.

import { element } from "./common.js";

const PERIOD = 1000 / 90; // ms between two messages, at least
const PINCH = [0.015, 0.03]; // m between thumb and forefinger, at which a pinch begins and ends
const MARKER = 0.03; // m, radius of what shows a hand
const COLORS = { idle: [0.6, 0.6, 0.6, 1], armed: [0.34, 0.71, 0.91, 1], leading: [0, 0.62, 0.45, 1] };
const HALF = Math.SQRT1_2;

// The world of WebXR has y upwards and z backwards, that of Drake z upwards: it is turned by 90 degrees about x.
export function inDrake({ position: p, orientation: q }) {
  const rotation = [HALF * (q.w - q.x), HALF * (q.x + q.w), HALF * (q.y - q.z), HALF * (q.z + q.y)];
  return [...rotation, p.x, -p.z, p.y];
}

// The pose in WebXR of a wearer who stands at (x, y) and looks along the heading, in Drake's world.
function standing([x, y, heading]) {
  const half = (heading - Math.PI / 2) / 2;
  return new XRRigidTransform({ x, y: 0, z: -y }, { x: 0, y: Math.sin(half), z: 0, w: Math.cos(half) });
}

// Meshcat's button asks for no tracked hands, and a headset tracks those only for a page that asks.
function askForHands() {
  for (const name of ["requestSession", "offerSession"]) {
    const begin = navigator.xr?.[name]?.bind(navigator.xr);
    const withHands = ({ optionalFeatures = [], ...rest } = {}) => ({ ...rest, optionalFeatures: [...optionalFeatures, "hand-tracking"] });
    if (begin) navigator.xr[name] = (mode, options) => begin(mode, withHands(options));
  }
}

export class VirtualReality {
  constructor(page) {
    this.page = page;
    this.status = {};
    this.sent = 0;
    this.pinches = new Set();
    this.arm = element("button", { id: "vtb-vr-arm", onclick: () => this.#tell(this.status.armed ? "disarm" : "arm") }, "arm");
    this.state = element("output", { id: "vtb-vr-state" });
    this.root = element(
      "section",
      { id: "vtb-vr", hidden: true },
      element("h2", {}, "Virtual reality"),
      (this.buttons = element("p", { className: "vtb-buttons" }, this.arm)),
      this.state,
    );
  }

  hello({ vr }) {
    if (this.vr || !vr.stand) return;
    this.vr = vr;
    this.root.hidden = false;
    this.arm.title = vr.real ? "let a hand lead the machine" : "let a hand lead the simulated robot";
    askForHands();
    viewer.handle_command({ type: "enable_webxr", mode: "vr" });
    this.buttons.append(viewer.xr_button);
    viewer.renderer.xr.addEventListener("sessionstart", () => this.#begin(viewer.renderer.xr.getSession()));
    addEventListener("pagehide", () => this.#tell("leave"));
    this.socket = new WebSocket(new URL("vr", location.href).href.replace(/^http/, "ws"));
    this.socket.onmessage = ({ data }) => this.#answer(JSON.parse(data));
    this.socket.onclose = () => this.#show({ armed: false, leading: false, notice: "the server has ended", refusal: "" });
  }

  frame() {}

  #tell(action) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify({ do: action }));
  }

  #answer(message) {
    if (message.type === "error") this.page.say(message.error, "bad", "vr");
    else this.#show(message);
  }

  #show(status) {
    this.status = status;
    this.arm.textContent = status.armed ? "disarm" : "arm";
    const what = this.vr.real ? "machine" : "simulated robot";
    const state = status.leading ? "leading" : status.armed ? "armed" : "idle";
    const refusal = status.armed && status.refusal ? `\nThis headset: ${status.refusal}.` : "";
    this.state.textContent = `${what}: ${status.notice}${refusal}`;
    document.body.dataset.vr = state;
    for (const side of this.shown ?? []) this.#color(side);
  }

  // -- in a headset

  async #begin(session) {
    this.shown = new Set();
    session.addEventListener("end", () => {
      this.#tell("leave");
      for (const side of this.shown) viewer.handle_command({ type: "delete", path: `vr/${side}` });
      this.shown.clear();
      document.body.dataset.headset = "left";
    });
    const floor = await session.requestReferenceSpace("local-floor");
    viewer.renderer.xr.setReferenceSpace(floor.getOffsetReferenceSpace(standing(this.vr.stand).inverse));
    document.body.dataset.headset = "entered";
    let due = 0;
    const track = (time, frame) => {
      session.requestAnimationFrame(track);
      if (time < due) return;
      due = Math.max(due + PERIOD, time + PERIOD / 2);
      this.#send(frame, session);
    };
    session.requestAnimationFrame(track);
  }

  #send(frame, session) {
    const space = viewer.renderer.xr.getReferenceSpace();
    const head = frame.getViewerPose(space);
    const message = { time: performance.now() / 1000, head: head && inDrake(head.transform), left: null, right: null };
    if (session.visibilityState === "visible")
      for (const source of session.inputSources)
        if (source.handedness in message) message[source.handedness] ??= this.#hand(frame, space, source);
    for (const side of ["left", "right"]) this.#mark(side, message[side]);
    // What cannot be sent now would be old when it is.
    if (this.socket.readyState !== WebSocket.OPEN || this.socket.bufferedAmount > 0) return;
    this.socket.send(JSON.stringify(message));
    document.body.dataset.poses = ++this.sent;
  }

  // Returns the pose of a grip, or of the wrist of a tracked hand, and whether it holds the clutch.
  #hand(frame, space, source) {
    const buttons = Array.from(source.gamepad?.buttons ?? [], ({ value }) => value);
    if (!source.hand) {
      const pose = source.gripSpace && frame.getPose(source.gripSpace, space);
      return pose ? { pose: inDrake(pose.transform), grip: !!source.gamepad?.buttons[1]?.pressed, buttons } : null;
    }
    const joint = (name) => frame.getJointPose(source.hand.get(name), space)?.transform;
    const [wrist, thumb, finger] = [joint("wrist"), joint("thumb-tip"), joint("index-finger-tip")];
    if (!wrist || !thumb || !finger) return null;
    const apart = Math.hypot(...["x", "y", "z"].map((axis) => thumb.position[axis] - finger.position[axis]));
    if (apart < PINCH[0]) this.pinches.add(source.handedness);
    if (apart > PINCH[1]) this.pinches.delete(source.handedness);
    return { pose: inDrake(wrist), grip: this.pinches.has(source.handedness), buttons };
  }

  #mark(side, hand) {
    const path = `vr/${side}`;
    if (!hand) {
      if (this.shown.delete(side)) viewer.handle_command({ type: "delete", path });
      return;
    }
    if (!this.shown.has(side)) {
      this.shown.add(side);
      const geometry = { uuid: `${path}/sphere`, type: "SphereGeometry", radius: MARKER, widthSegments: 16, heightSegments: 12 };
      const material = { uuid: `${path}/color`, type: "MeshPhongMaterial", color: 0xffffff };
      const object = { uuid: path, type: "Mesh", geometry: geometry.uuid, material: material.uuid };
      const metadata = { version: 4.5, type: "Object" };
      viewer.handle_command({ type: "set_object", path, object: { metadata, geometries: [geometry], materials: [material], object } });
      this.#color(side);
    }
    const [x, y, z] = hand.pose.slice(4);
    viewer.handle_command({ type: "set_transform", path, matrix: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, x, y, z, 1] });
  }

  #color(side) {
    const value = COLORS[document.body.dataset.vr] ?? COLORS.idle;
    viewer.handle_command({ type: "set_property", path: `vr/${side}`, property: "color", value });
  }
}

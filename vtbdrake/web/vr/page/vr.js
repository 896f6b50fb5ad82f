// A headset leads the robot: what it tracks is sent to the server, which decides what becomes of it.

import { element } from "./common.js";

/** @typedef {"left" | "right"} Side */
/** @typedef {{ pose: number[], grip: boolean, buttons: number[] }} Hand pose is [w, x, y, z, px, py, pz] */
/** @typedef {{ armed: boolean, leading: boolean, notice: string, refusal: string }} Status */
/** @typedef {{ stand: [number, number, number] | null, real: boolean }} Description of a robot that a hand leads */

const PERIOD = 1000 / 90; // ms between two messages, at least
const PINCH = [0.015, 0.03]; // m between thumb and forefinger, at which a pinch begins and ends
const MARKER = 0.03; // m, radius of what shows a hand
/** @type {Record<string, number[]>} */
const COLORS = { idle: [0.6, 0.6, 0.6, 1], armed: [0.34, 0.71, 0.91, 1], leading: [0, 0.62, 0.45, 1] };
const HALF = Math.SQRT1_2;
/** @type {Side[]} */
const SIDES = ["left", "right"];

/**
 * The world of WebXR has y upwards and z backwards, Drake's has z upwards: it is turned by 90 degrees about x.
 *
 * @param {Pick<XRRigidTransform, "position" | "orientation">} pose
 */
export function inDrake({ position: p, orientation: q }) {
  const rotation = [HALF * (q.w - q.x), HALF * (q.x + q.w), HALF * (q.y - q.z), HALF * (q.z + q.y)];
  return [...rotation, p.x, -p.z, p.y];
}

/**
 * The pose in WebXR of a wearer who stands at (x, y) and looks along the heading, in Drake's world.
 *
 * @param {[number, number, number]} place
 */
function standing([x, y, heading]) {
  const half = (heading - Math.PI / 2) / 2;
  return new XRRigidTransform({ x, y: 0, z: -y }, { x: 0, y: Math.sin(half), z: 0, w: Math.cos(half) });
}

// Meshcat's button asks for no tracked hands, and a headset tracks those only for a page that asks.
function askForHands() {
  /** @type {any} */
  const xr = navigator.xr;
  for (const name of ["requestSession", "offerSession"]) {
    const begin = xr?.[name]?.bind(xr);
    /** @param {XRSessionInit} options */
    const withHands = ({ optionalFeatures = [], ...rest } = {}) => ({
      ...rest,
      optionalFeatures: [...optionalFeatures, "hand-tracking"],
    });
    /** @type {(mode: XRSessionMode, options?: XRSessionInit) => Promise<XRSession>} */
    const beginWithHands = (mode, options) => begin(mode, withHands(options));
    if (begin) xr[name] = beginWithHands;
  }
}

export class VirtualReality {
  /** @type {Description | null} */
  vr = null;
  /** @type {WebSocket | null} */
  socket = null;
  /** @type {Status} */
  status = { armed: false, leading: false, notice: "", refusal: "" };
  sent = 0;
  /** @type {Set<Side>} the hands that pinch */
  pinches = new Set();
  /** @type {Set<Side>} the hands that have a marker */
  shown = new Set();

  /** @param {import("./common.js").Telling} page */
  constructor(page) {
    this.page = page;
    this.arm = element(
      "button",
      { id: "vtb-vr-arm", onclick: () => this.#tell(this.status.armed ? "disarm" : "arm") },
      "arm",
    );
    this.state = element("output", { id: "vtb-vr-state" });
    this.root = element(
      "section",
      { id: "vtb-vr", hidden: true },
      element("h2", {}, "Virtual reality"),
      (this.buttons = element("p", { className: "vtb-buttons" }, this.arm)),
      this.state,
    );
  }

  /** @param {{ vr: Description }} message */
  hello({ vr }) {
    if (this.vr || !vr.stand) return;
    this.vr = vr;
    this.root.hidden = false;
    this.arm.title = vr.real ? "let a hand lead the machine" : "let a hand lead the simulated robot";
    askForHands();
    viewer.handle_command({ type: "enable_webxr", mode: "vr" });
    this.buttons.append(viewer.xr_button);
    const { stand } = vr;
    viewer.renderer.xr.addEventListener("sessionstart", () => {
      this.page.orTell(this.#begin(viewer.renderer.xr.getSession(), stand), "vr");
    });
    addEventListener("pagehide", () => this.#tell("leave"));
    this.socket = new WebSocket(new URL("vr", location.href).href.replace(/^http/, "ws"));
    this.socket.onmessage = ({ data }) => this.#answer(JSON.parse(data));
    this.socket.onclose = () =>
      this.#show({ armed: false, leading: false, notice: "the server has ended", refusal: "" });
  }

  frame() {}

  /** @param {"arm" | "disarm" | "leave"} action */
  #tell(action) {
    if (this.socket?.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify({ do: action }));
    else if (action !== "leave") this.page.say("the server has ended: no hand leads", "bad", "vr");
  }

  /** @param {any} message a `Status`, or an error */
  #answer(message) {
    if (message.type === "error") this.page.say(message.error, "bad", "vr");
    else this.#show(message);
  }

  /** @param {Status} status */
  #show(status) {
    if (status.armed && !this.status.armed) this.page.takeBack("vr"); // What was refused before is over.
    this.status = status;
    this.arm.textContent = status.armed ? "disarm" : "arm";
    const what = this.vr?.real ? "machine" : "simulated robot";
    const state = status.leading ? "leading" : status.armed ? "armed" : "idle";
    const refusal = status.armed && status.refusal ? `\nThis headset: ${status.refusal}.` : "";
    this.state.textContent = `${what}: ${status.notice}${refusal}`;
    document.body.dataset.vr = state;
    for (const side of this.shown) this.#color(side);
  }

  // -- in a headset

  /**
   * @param {XRSession} session
   * @param {[number, number, number]} stand where the wearer stands
   */
  async #begin(session, stand) {
    this.shown.clear();
    session.addEventListener("end", () => {
      this.#tell("leave");
      for (const side of this.shown) viewer.handle_command({ type: "delete", path: `vr/${side}` });
      this.shown.clear();
      document.body.dataset.headset = "left";
    });
    const floor = await session.requestReferenceSpace("local-floor");
    viewer.renderer.xr.setReferenceSpace(floor.getOffsetReferenceSpace(standing(stand).inverse));
    document.body.dataset.headset = "entered";
    let due = 0;
    /** @type {XRFrameRequestCallback} */
    const track = (time, frame) => {
      session.requestAnimationFrame(track);
      if (time < due) return;
      due = Math.max(due + PERIOD, time + PERIOD / 2);
      this.#send(frame, session);
    };
    session.requestAnimationFrame(track);
  }

  /**
   * @param {XRFrame} frame
   * @param {XRSession} session
   */
  #send(frame, session) {
    /** @type {XRReferenceSpace} */
    const space = viewer.renderer.xr.getReferenceSpace();
    const head = frame.getViewerPose(space);
    /** @type {Record<Side, Hand | null>} */
    const hands = { left: null, right: null };
    if (session.visibilityState === "visible")
      for (const source of session.inputSources)
        if (source.handedness !== "none")
          hands[source.handedness] ??= this.#hand(frame, space, source, source.handedness);
    for (const side of SIDES) this.#mark(side, hands[side]);
    // What cannot be sent now would be old when it is.
    if (this.socket?.readyState !== WebSocket.OPEN || this.socket.bufferedAmount > 0) return;
    const message = { time: performance.now() / 1000, head: head ? inDrake(head.transform) : null, ...hands };
    this.socket.send(JSON.stringify(message));
    this.sent += 1;
    document.body.dataset.poses = String(this.sent);
  }

  /**
   * @param {XRFrame} frame
   * @param {XRReferenceSpace} space
   * @param {XRInputSource} source
   * @param {Side} side
   * @returns {Hand | null} the pose of a grip, or of the wrist of a tracked hand, and whether it holds the clutch
   */
  #hand(frame, space, source, side) {
    const buttons = Array.from(source.gamepad?.buttons ?? [], ({ value }) => value);
    if (!source.hand) {
      const pose = source.gripSpace && frame.getPose(source.gripSpace, space);
      return pose ? { pose: inDrake(pose.transform), grip: !!source.gamepad?.buttons[1]?.pressed, buttons } : null;
    }
    const { hand } = source;
    /** @param {XRHandJoint} name */
    const joint = (name) => {
      const place = hand.get(name);
      return place && frame.getJointPose?.(place, space)?.transform;
    };
    const [wrist, thumb, finger] = [joint("wrist"), joint("thumb-tip"), joint("index-finger-tip")];
    if (!wrist || !thumb || !finger) return null;
    const [p, q] = [thumb.position, finger.position];
    const apart = Math.hypot(p.x - q.x, p.y - q.y, p.z - q.z);
    if (apart < PINCH[0]) this.pinches.add(side);
    if (apart > PINCH[1]) this.pinches.delete(side);
    return { pose: inDrake(wrist), grip: this.pinches.has(side), buttons };
  }

  /**
   * Shows a hand, or no hand.
   *
   * @param {Side} side
   * @param {Hand | null} hand
   */
  #mark(side, hand) {
    const path = `vr/${side}`;
    if (!hand) {
      if (this.shown.delete(side)) viewer.handle_command({ type: "delete", path });
      return;
    }
    if (!this.shown.has(side)) {
      this.shown.add(side);
      const geometry = {
        uuid: `${path}/sphere`,
        type: "SphereGeometry",
        radius: MARKER,
        widthSegments: 16,
        heightSegments: 12,
      };
      const material = { uuid: `${path}/color`, type: "MeshPhongMaterial", color: 0xffffff };
      const object = { uuid: path, type: "Mesh", geometry: geometry.uuid, material: material.uuid };
      const metadata = { version: 4.5, type: "Object" };
      viewer.handle_command({
        type: "set_object",
        path,
        object: { metadata, geometries: [geometry], materials: [material], object },
      });
      this.#color(side);
    }
    const [x, y, z] = hand.pose.slice(4);
    viewer.handle_command({ type: "set_transform", path, matrix: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, x, y, z, 1] });
  }

  /** @param {Side} side */
  #color(side) {
    const value = COLORS[document.body.dataset.vr ?? "idle"] ?? COLORS.idle;
    viewer.handle_command({ type: "set_property", path: `vr/${side}`, property: "color", value });
  }
}

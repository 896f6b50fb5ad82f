// The bar of a study's page: the time of the rollouts that are shown, and what colour each of them has.

import { element } from "./common.js";

const TIME_PERIOD = 50; // ms between two instants of the animation
/** @type {Record<string, string>} */
const LEGEND = { best: "var(--soft)", pointed: "var(--pointed)", tried: "var(--tried)" };

export class Playback {
  time = 0;
  duration = 0;
  playing = false;
  #sends = false; // whether an instant is on its way
  #sent = 0;

  /**
   * @param {(command: string, fields: object) => Promise<any>} ask sends a command to the server
   * @param {boolean} simulates whether rollouts are simulated; nothing is sent otherwise
   * @param {HTMLElement[]} others stand behind its own elements
   */
  constructor(ask, simulates, ...others) {
    this.ask = ask;
    this.simulates = simulates;
    const toggle = () => this.play(!this.playing);
    this.button = element("button", { id: "vtb-play", title: "play or pause (space)", onclick: toggle }, "play");
    this.slider = element("input", {
      id: "vtb-time",
      type: "range",
      min: 0,
      max: 1,
      step: "any",
      value: 0,
      title: "time of the rollouts",
      ariaLabel: "time of the rollouts",
      oninput: () => this.setTime(Number(this.slider.value)),
    });
    this.clock = element("output", { id: "vtb-clock" }, "0.00 s");
    this.keys = Object.fromEntries(Object.entries(LEGEND).map(([name, tint]) => [name, key(name, tint)]));
    const parts = [this.button, this.clock, this.slider, ...Object.values(this.keys), ...others];
    this.bar = element("footer", { id: "vtb-bar" }, ...parts);
  }

  /**
   * Shows or hides a colour, with its text.
   *
   * @param {string} name
   * @param {boolean} shown
   */
  legend(name, shown, text = "") {
    this.keys[name].hidden = !shown;
    if (text) /** @type {ChildNode} */ (this.keys[name].lastChild).textContent = text;
  }

  /** @param {number} seconds of a rollout: the time reaches to the end of the longest one */
  extend(seconds) {
    this.duration = Math.max(this.duration, seconds);
    this.slider.max = this.duration || 1;
  }

  /** @param {number} time */
  setTime(time) {
    this.time = Math.min(Math.max(time, 0), this.duration);
    this.slider.value = this.time;
    this.clock.textContent = `${this.time.toFixed(2)} s`;
    if (!this.simulates || this.#sends) return;
    this.#sends = true;
    this.#sent = this.time;
    this.ask("time", { time: this.time })
      .catch(() => {})
      .finally(() => {
        document.body.dataset.time = String(this.time);
        setTimeout(() => {
          this.#sends = false;
          if (this.#sent !== this.time) this.setTime(this.time);
        }, TIME_PERIOD);
      });
  }

  /** @param {boolean} playing */
  play(playing) {
    this.playing = playing;
    this.button.textContent = playing ? "pause" : "play";
    if (!playing) return;
    let last = performance.now();
    if (this.time >= this.duration) this.setTime(0);
    /** @type {FrameRequestCallback} */
    const step = (now) => {
      if (!this.playing) return;
      this.setTime(this.time + (now - last) / 1000);
      last = now;
      if (this.time >= this.duration) return this.play(false);
      requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }
}

/**
 * @param {string} name
 * @param {string} tint
 * @returns {HTMLElement}
 */
function key(name, tint) {
  const square = element("i", { style: `background:${tint}` });
  return element("span", { className: "vtb-key", id: `vtb-key-${name}`, hidden: true }, square, name);
}

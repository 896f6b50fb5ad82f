// Saves the present as a snapshot, and what was set or driven last as a test for pytest, or as a trial of a study.

import { element } from "./common.js";

export class Keep {
  /** @param {any} page */
  constructor(page) {
    this.page = page;
    this.snapshot = element(
      "button",
      { id: "vtb-save", title: "with this camera, for vtbdrake open", onclick: () => this.#saveSnapshot() },
      "save the present",
    );
    this.name = element("input", {
      type: "text",
      id: "vtb-test-name",
      placeholder: "name_of_the_test",
      pattern: "[a-z0-9_]+",
      "aria-label": "name of the test",
    });
    this.test = element(
      "button",
      {
        id: "vtb-save-test",
        title: "what was set or driven last, with the state before it and what is expected",
        onclick: () => this.#saveTest(),
      },
      "save as test",
    );
    this.trial = element(
      "button",
      {
        id: "vtb-store-trial",
        hidden: true,
        title: "the last drive, marked as driven",
        onclick: () => this.#storeTrial(),
      },
      "store the drive as a trial",
    );
    this.root = element(
      "details",
      { id: "vtb-keep" },
      element("summary", {}, "Save"),
      element("p", { className: "vtb-buttons" }, this.snapshot),
      element("p", { className: "vtb-buttons" }, this.name, this.test),
      element("p", { className: "vtb-buttons" }, this.trial),
    );
  }

  /** @param {{ study: string }} message */
  hello({ study }) {
    this.trial.hidden = !study;
    this.trial.textContent = `store the drive as a trial of ${study}`;
  }

  /** @param {object} _frame tells nothing that is kept */
  frame(_frame) {}

  // The camera is noted in Drake's world, which three.js turns by -90 degrees about x.
  async #saveSnapshot() {
    const [position, target] = [viewer.camera.position, viewer.controls.target].map(({ x, y, z }) => [x, -z, y]);
    const data = await this.page.ask("snapshot", { position, target });
    if (!data) return;
    const href = URL.createObjectURL(new Blob([Uint8Array.from(atob(data), (c) => c.charCodeAt(0))]));
    const name = `${this.page.title.textContent}-${this.page.clock.textContent.replace(" ", "")}.vtb`;
    element("a", { href, download: name }).click();
    URL.revokeObjectURL(href);
  }

  async #saveTest() {
    if (!this.name.reportValidity() || !this.name.value) return this.name.focus();
    this.test.disabled = true;
    const path = await this.page.ask("save_test", { name: this.name.value });
    this.test.disabled = false;
    if (path) this.page.say(`saved: ${path}`, "draft");
  }

  async #storeTrial() {
    const text = await this.page.ask("store_trial");
    if (text) this.page.say(text, "draft");
  }
}

// Saves what was set or driven last: as a test for pytest, or as a trial of a study.

import { element } from "./common.js";

export class Keep {
  constructor(page) {
    this.page = page;
    this.name = element("input", { type: "text", id: "vtb-test-name", placeholder: "name_of_the_test", pattern: "[a-z0-9_]+", "aria-label": "name of the test" });
    this.test = element("button", { id: "vtb-save-test", title: "what was set or driven last, with the state before it and what is expected", onclick: () => this.#saveTest() }, "save as test");
    this.trial = element("button", { id: "vtb-store-trial", hidden: true, title: "the last drive, marked as driven", onclick: () => this.#storeTrial() }, "store the drive as a trial");
    this.root = element(
      "details",
      { id: "vtb-keep" },
      element("summary", {}, "Save"),
      element("p", { className: "vtb-buttons" }, this.name, this.test),
      element("p", { className: "vtb-buttons" }, this.trial),
    );
  }

  hello({ study }) {
    this.trial.hidden = !study;
    this.trial.textContent = `store the drive as a trial of ${study}`;
  }

  frame() {}

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

// The controls of a session, beside Meshcat's viewer, whose page loads this module.

import { Connection, Telling, button, element, load, number } from "./common.js";
import { Drive } from "./drive.js";
import { Layers } from "./layers.js";
import { Loop } from "./loop.js";
import { draggables } from "./pad.js";
import { Recorded } from "./recorded.js";
import { Keep } from "./keep.js";
import { VirtualReality } from "./vr.js";

const SPEEDS = [0.125, 0.25, 0.5, 1, 2, 4, 8];
const WINDOW = 20; // s of simulated time in a plot
// Positions of T_sense and T_act -> mode.
const MODES = { "sim,sim": "sim", "real,sim": "shadow", "real,real": "real", "real,twin": "twin", "real,idle": "idle" };
const MATCHES = 60; // addresses that the search lists
const ENTRIES = 12; // entries of an array that get a slider
const PREVIEW_PERIOD = 100; // ms between two drafts

// -- a watched variable

class Watched {
  constructor(page, address, variable) {
    Object.assign(this, { page, address, variable, values: [] });
    this.draft = "none"; // "open" while a slider is dragged, "cancelled" until it is released

    const size = variable.shape.reduce((product, n) => product * n, 1);
    this.size = Math.min(size, ENTRIES);
    this.entries = Array.from({ length: this.size }, (_, index) => this.#entry(index));
    this.draggables = draggables(this);
    this.root = element(
      "section",
      { className: "vtb-watched" },
      element(
        "header",
        {},
        element("b", {}, address),
        element("span", {}, variable.unit === "1" ? "" : variable.unit),
        element("button", { className: "plain", title: "plot", onclick: () => this.togglePlot() }, "plot"),
        element("button", { className: "plain", title: "remove", onclick: () => page.unwatch(this) }, "×"),
      ),
      ...this.entries.map((entry) => entry.row),
      ...this.draggables.filter(({ root }) => !root.isConnected).map(({ root }) => root),
      size > ENTRIES ? element("small", {}, `and ${size - ENTRIES} more entries`) : "",
    );
    this.root.dataset.address = address;
  }

  #entry(index) {
    const settable = this.variable.settable;
    const [lower, upper] = this.variable.bounds.map((bounds) => bounds[index]);
    const text = element("input", {
      type: "text",
      readOnly: !settable,
      "aria-label": `${this.address}[${index}]`,
      onchange: () => {
        this.typing = false; // What was refused gives way to the present value.
        this.commit({ [index]: text.value.trim() ? Number(text.value) : NaN });
      },
      onfocus: () => (this.typing = true),
      oninput: () => (this.typing = true),
      onblur: () => (this.typing = false),
    });
    if (!settable) return { text, row: element("div", { className: "vtb-entry fixed" }, text) };
    const slider = element("input", {
      type: "range",
      step: "any",
      "aria-label": `${this.address}[${index}]`,
      onpointerdown: () => (this.draft = "none"),
      oninput: () => this.preview({ [index]: Number(slider.value) }),
      onchange: () => this.commit({ [index]: Number(slider.value) }),
    });
    const row = element("div", { className: "vtb-entry" }, slider, text);
    return { text, slider, row, lower, upper, ranged: false };
  }

  // Returns the value of the variable with other entries, by index.
  #with(changes) {
    const values = this.#changed(changes);
    return this.variable.shape.length ? this.page.shaped(values, this.variable.shape) : values[0];
  }

  #changed(changes) {
    return this.values.map((old, index) => changes[index] ?? old);
  }

  // A drag is a draft: a fork of now runs ahead with it.
  preview(changes) {
    if (this.draft === "cancelled") return;
    this.draft = "open";
    for (const [index, value] of Object.entries(changes)) {
      this.entries[index].row.classList.add("draft");
      this.entries[index].text.value = number(value);
      this.entries[index].slider.value = value;
    }
    for (const part of this.draggables) part.show(this.#changed(changes));
    this.page.preview(this, { [this.address]: this.#with(changes) });
  }

  // The release commits, unless the draft was cancelled.
  commit(changes) {
    const cancelled = this.draft === "cancelled";
    this.close("none");
    if (cancelled) return;
    if (!Object.values(changes).every(Number.isFinite)) return this.page.say(`${this.address} takes a number`, "bad");
    this.page.commit({ [this.address]: this.#with(changes) });
  }

  close(draft) {
    this.draft = draft;
    for (const { row } of this.entries) row.classList.remove("draft");
  }

  show(time, value) {
    this.values = Array.isArray(value) ? value : [value];
    this.entries.forEach((entry, index) => {
      const now = this.values[index];
      if (this.draft === "open" || this.typing) return;
      entry.text.value = number(now);
      if (!entry.slider) return;
      if (!entry.ranged || now < Number(entry.slider.min) || now > Number(entry.slider.max)) {
        const reach = Math.max(2 * Math.abs(now), 1);
        entry.slider.min = entry.lower ?? now - reach;
        entry.slider.max = entry.upper ?? now + reach;
        entry.ranged = true;
      }
      entry.slider.value = now;
    });
    if (this.draft !== "open") for (const part of this.draggables) part.show(this.values);
    this.#extend(time);
  }

  togglePlot() {
    if (this.plot) {
      this.plot.destroy();
      this.plot = null;
      return;
    }
    this.data = [[], ...Array.from({ length: this.size }, () => [])];
    const colors = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9"];
    this.plot = new uPlot(
      {
        width: this.root.clientWidth - 18,
        height: 130,
        legend: { show: false },
        scales: { x: { time: false }, y: { range: (_, least, most) => (least < most ? [least, most] : [least - 1, most + 1]) } },
        axes: [{ size: 24, space: 60 }, { size: 52 }],
        series: [{}, ...this.entries.map((_, i) => ({ stroke: colors[i % colors.length], width: 1.5 }))],
      },
      this.data,
      this.root,
    );
  }

  #extend(time) {
    if (!this.plot) return;
    let [times] = this.data;
    while (times.length && times.at(-1) >= time) this.data.forEach((series) => series.pop());
    times.push(time);
    this.values.slice(0, this.size).forEach((value, i) => this.data[i + 1].push(value));
    while (times.length && times[0] < time - WINDOW) this.data.forEach((series) => series.shift());
    this.plot.setData(this.data);
  }
}

// -- the page

class Page extends Telling {
  constructor() {
    super();
    this.watched = new Map();
    this.variables = {};
    this.frames = 0;
    // Each has a section of the panel in `root`, and is told of the session's messages.
    this.parts = [new Recorded(this), new Drive(this), new Layers(this), new Keep(this), new Loop(this), new VirtualReality(this)];
    this.#build();
    this.session = new Connection({
      hello: (message) => this.#hello(message),
      frame: (frame) => this.#frame(frame),
      closed: () => {
        document.body.dataset.session = "ended";
        this.say("the session has ended", "bad", "closed");
      },
    });
    document.addEventListener("keydown", (event) => this.#key(event));
  }

  #build() {
    this.title = element("h1");
    this.search = element("input", {
      type: "search",
      placeholder: "find an address",
      oninput: () => this.#find(),
      onkeydown: (event) => event.key === "Enter" && this.matches.children.length === 1 && this.matches.firstChild.click(),
    });
    this.matches = element("ul", { id: "vtb-matches" });
    this.sections = element("div");
    this.switches = element("div", { id: "vtb-switches" });
    this.differences = element("table", { id: "vtb-differences" });
    this.compare = element("input", { type: "checkbox", id: "vtb-compare" });
    this.follow = element("select", { id: "vtb-follow", onchange: () => this.follow.blur() }, element("option", { value: "" }, "nothing"));
    document.body.append(
      element(
        "aside",
        { id: "vtb-panel" },
        this.title,
        element("h2", {}, "Variables"),
        this.search,
        this.matches,
        this.sections,
        element("p", {}, element("label", {}, this.compare, " show the course without the change, too")),
        this.differences,
        ...this.parts.map((part) => part.root),
        element("h2", {}, "Switches"),
        this.switches,
        element("h2", {}, "Camera"),
        element("label", {}, "follows ", this.follow),
      ),
      element(
        "footer",
        { id: "vtb-bar" },
        button("vtb-fold", "☰", "show or hide the panel", () => this.#fold()),
        (this.playButton = button("vtb-play", "play", "play or pause (space)", () => this.toggle())),
        button("vtb-step", "step", "one step (.)", () => this.ask("step")),
        button("vtb-reset", "reset", "begin again (r)", () => this.ask("reset")),
        (this.speed = element(
          "select",
          { id: "vtb-speed", title: "speed (+ and -)", onchange: () => this.ask("speed", { speed: Number(this.speed.value) }) },
          ...SPEEDS.map((speed) => element("option", { value: speed }, speed < 1 ? `1/${1 / speed} ×` : `${speed} ×`)),
        )),
        (this.clock = element("output", { id: "vtb-time", title: "simulated time" })),
        (this.rate = element("output", { id: "vtb-rate", title: "simulated seconds per second" })),
        (this.mode = element("output", { id: "vtb-mode", title: "mode of the switches" })),
        (this.history = element("input", { id: "vtb-history", type: "range", step: "any", title: "go back", oninput: () => this.#scrub() })),
      ),
    );
    this.speed.value = 1;
    dispatchEvent(new Event("resize"));
  }

  #hello(message) {
    const { scenario, variables, bodies } = message;
    this.variables = variables;
    this.loop = message.loop;
    for (const part of this.parts) part.hello(message);
    this.follow.append(...bodies.map((path) => element("option", { value: path }, path.replace(/^now\//, ""))));
    this.follow.value = message.followed;
    this.followed = undefined;
    this.title.textContent = scenario.split(":").at(-1);
    this.title.title = scenario;
    document.title = this.title.textContent;
    document.body.dataset.session = "open";
  }

  ask(command, fields) {
    return this.session.ask(command, fields).catch((error) => this.say(error.message, "bad"));
  }

  // -- variables

  #find() {
    const words = this.search.value.toLowerCase().split(/\s+/).filter(Boolean);
    const addresses = words.length ? Object.keys(this.variables).filter((a) => words.every((word) => a.toLowerCase().includes(word))) : [];
    this.matches.replaceChildren(
      ...addresses.slice(0, MATCHES).map((address) =>
        element(
          "li",
          { tabIndex: 0, onclick: () => this.watch(address), onkeydown: (event) => event.key === "Enter" && this.watch(address) },
          address,
          element("span", {}, this.variables[address].unit === "1" ? "" : this.variables[address].unit),
        ),
      ),
    );
  }

  watch(address) {
    if (this.watched.has(address)) return;
    const watched = new Watched(this, address, this.variables[address]);
    this.watched.set(address, watched);
    this.sections.prepend(watched.root);
    this.#askToWatch();
  }

  unwatch(watched) {
    watched.root.remove();
    for (const part of watched.draggables) part.remove();
    this.watched.delete(watched.address);
    this.#askToWatch();
  }

  #askToWatch() {
    this.ask("watch", { addresses: [...this.watched.keys()] });
  }

  shaped(values, [first, ...rest]) {
    if (!rest.length) return values;
    const size = rest.reduce((product, n) => product * n, 1);
    return Array.from({ length: first }, (_, i) => this.shaped(values.slice(i * size, (i + 1) * size), rest));
  }

  preview(watched, values) {
    this.draft = { watched, values };
    if (this.loop) return;
    this.timer ??= setTimeout(() => {
      this.timer = null;
      if (this.draft) this.ask("preview", { values: this.draft.values });
    }, PREVIEW_PERIOD);
  }

  commit(values) {
    this.draft = null;
    this.ask("write", { values, compare: this.compare.checked });
  }

  cancel() {
    this.draft?.watched.close("cancelled");
    this.draft = null;
    if (this.loop) return;
    this.ask("cancel_preview");
    this.ask("cancel_comparison");
  }

  // -- time

  toggle() {
    return this.ask(this.playing ? "pause" : "play");
  }

  #changeSpeed(by) {
    const index = SPEEDS.indexOf(Number(this.speed.value)) + by;
    if (SPEEDS[index]) this.ask("speed", { speed: SPEEDS[index] });
  }

  #scrub() {
    this.scrubbing = performance.now();
    this.seekTimer ??= setTimeout(() => {
      this.seekTimer = null;
      this.ask("seek", { time: Number(this.history.value) });
    }, PREVIEW_PERIOD);
  }

  #key(event) {
    if (event.target.matches("input[type=text], input[type=search], select")) {
      if (event.key === "Escape") event.target.blur();
      return;
    }
    const actions = {
      " ": () => this.toggle(),
      ".": () => this.ask("step"),
      r: () => this.ask("reset"),
      "+": () => this.#changeSpeed(1),
      "-": () => this.#changeSpeed(-1),
      Escape: () => this.cancel(),
    };
    if (event.ctrlKey || event.metaKey || event.altKey || !actions[event.key]) return;
    if (this.loop && !["r", "Escape"].includes(event.key)) return;
    event.preventDefault();
    actions[event.key]();
  }

  // -- what comes from the session

  #frame(frame) {
    this.playing = frame.playing;
    this.playButton.textContent = frame.playing ? "pause" : "play";
    this.clock.textContent = `${frame.time.toFixed(3)} s`;
    this.rate.textContent = frame.playing ? `${frame.rate.toFixed(2)} ×` : this.loop ? "no values" : "paused";
    if (document.activeElement !== this.speed) this.speed.value = frame.speed;
    [this.history.min, this.history.max] = frame.history;
    if (!(performance.now() - this.scrubbing < 500)) this.history.value = frame.time;
    for (const [address, value] of Object.entries(frame.values)) this.watched.get(address)?.show(frame.time, value);
    this.#showSwitches(frame.positions);
    this.#showState(frame);
    for (const part of this.parts) part.frame(frame);
    this.frames += 1;
    document.body.dataset.frame = frame.number;
    document.body.dataset.frames = this.frames;
  }

  #showState({ steers, failure, warnings, preview, comparison }) {
    if (steers) this.takeBack("steering");
    else if (!this.told("steering")) {
      const take = element("button", { id: "vtb-take", onclick: () => this.ask("take over") }, "steer here");
      this.say("another page steers: this one watches ", "", "steering").append(take);
    }
    if (failure) this.say(this.loop ? failure : `the simulation has failed: ${failure}`, "bad", "failure");
    else this.takeBack("failure");
    if (warnings.length) this.say(warnings.join("; "), "bad", "warnings");
    else this.takeBack("warnings");
    if (!preview) this.takeBack("preview");
    else if (preview.refused) this.say(`preview: ${preview.refused}, at ${preview.time.toFixed(2)} s`, "bad", "preview");
    else this.say(`preview until ${preview.time.toFixed(2)} s`, "draft", "preview");
    const rows = comparison?.differences.slice(0, 12) ?? [];
    const course = comparison?.recorded ? "recorded course (purple)" : comparison?.branch ? "other branch (orange)" : "course without the change (blue)";
    const title = rows.length ? `differs first from the ${course}:` : `no difference yet from the ${course}`;
    if (this.differences.rows.length !== (comparison ? rows.length + 1 : 0) || (comparison && this.differences.rows[0].textContent !== title)) {
      const head = element("tr", {}, element("td", { colSpan: 2 }, title));
      const cells = rows.map(([address, time]) => element("tr", {}, element("td", {}, address), element("td", {}, `${time.toFixed(3)} s`)));
      this.differences.replaceChildren(...(comparison ? [head, ...cells] : []));
    }
  }

  #showSwitches(positions) {
    for (const [side, signals] of Object.entries(positions)) {
      if (Object.keys(signals).length > 1) this.#showSwitch(`vtb-${side}`, side, null, Object.values(signals));
      for (const [signal, position] of Object.entries(signals)) this.#showSwitch(`vtb-${side}-${signal}`, side, signal, [position]);
    }
    const [senses, acts] = ["sense", "act"].map((side) => [...new Set(Object.values(positions[side] ?? {}))]);
    const mode = senses.length > 1 || acts.length > 1 ? "mixed" : MODES[[senses[0] ?? "sim", acts[0] ?? senses[0] ?? "sim"]];
    this.mode.textContent = Object.keys(positions).length ? mode ?? "mixed" : "unknown";
    this.mode.dataset.mode = this.mode.textContent;
  }

  // The switch of a signal, or of all signals of a side.
  #showSwitch(id, side, signal, positions) {
    let chosen = document.getElementById(id);
    if (!chosen) {
      const places = side === "sense" ? ["sim", "real"] : ["sim", "real", "twin"];
      chosen = element("select", { id, onchange: () => this.#throw(chosen, side, signal) }, ...places.map((p) => element("option", {}, p)));
      const label = element("label", { htmlFor: id }, signal ? `T_${side}.${signal}` : `T_${side}, all signals`);
      this.switches.append(element("div", { className: "vtb-switch" }, label, chosen, element("small", { className: "bad" })));
    }
    if (document.activeElement === chosen) return;
    const position = new Set(positions).size > 1 ? "mixed" : positions[0];
    let option = [...chosen.options].find(({ value }) => value === position);
    if (!option) chosen.append((option = element("option", { hidden: true }, position)));
    option.selected = true;
    chosen.disabled = Boolean(this.loop);
    if (this.loop) chosen.title = "a running loop alone throws its switches";
  }

  #throw(chosen, side, signal) {
    const reason = chosen.parentElement.querySelector("small");
    this.session.ask("switch", { [side]: signal ? { [signal]: chosen.value } : chosen.value }).then(
      () => (reason.textContent = ""),
      (error) => (reason.textContent = error.message),
    );
    chosen.blur();
  }

  // -- the scene

  #fold() {
    document.body.classList.toggle("vtb-folded");
    dispatchEvent(new Event("resize"));
  }

  // Called in each animation frame: what it follows keeps its place in the picture.
  followBody() {
    requestAnimationFrame(() => this.followBody());
    const name = this.follow.value;
    if (name) {
      const { object } = viewer.scene_tree.find(["drake", ...name.split("/")]);
      const place = object.matrixWorld.elements.slice(12, 15);
      const { camera, controls } = viewer;
      if (this.followed === undefined) {
        if (!place.some((value) => value)) return; // It has not been placed yet.
        const middle = controls.target.toArray();
        const away = Math.hypot(...place.map((value, i) => value - middle[i]));
        // The camera was put where the robot began, which may have walked away since.
        this.place = away > 0.3 * camera.position.distanceTo(controls.target) ? middle : place;
        this.followed = name;
      }
      if (this.followed === name) {
        const [x, y, z] = place.map((value, i) => value - this.place[i]);
        for (const point of [camera.position, controls.target]) {
          point.x += x;
          point.y += y;
          point.z += z;
        }
      }
      this.place = place;
    }
    this.followed = name;
  }
}

await Promise.all([
  load("link", { rel: "stylesheet", href: "page/view.css" }),
  load("link", { rel: "stylesheet", href: "page/vendor/uPlot.min.css" }),
  load("script", { src: "page/vendor/uPlot.iife.min.js" }),
]);
window.vtb = new Page();
vtb.followBody();

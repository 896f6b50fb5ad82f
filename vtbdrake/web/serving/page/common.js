// Elements and connection of the pages.

/**
 * @param {string} tag
 * @param {Record<string, any>} properties properties, attributes, and by on... listeners
 * @param {any[]} children
 * @returns {any} an element of that tag, whose type depends on it
 */
export function element(tag, properties = {}, ...children) {
  /** @type {any} */
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (name in made) made[name] = value;
    else made.setAttribute(name, value);
  }
  made.append(...children);
  return made;
}

/**
 * @param {"script" | "link"} tag
 * @param {Record<string, any>} properties
 * @returns {Promise<Event>} fulfilled when it is loaded
 */
export function load(tag, properties) {
  return new Promise((resolve, reject) => {
    document.head.append(element(tag, { ...properties, onload: resolve, onerror: reject }));
  });
}

/**
 * @param {number | string | null | undefined} value
 * @param {number} [digits]
 * @returns {string} its text; "none" for none
 */
export const number = (value, digits = 5) =>
  value === null || value === undefined ? "none" : String(Number(Number(value).toPrecision(digits)));

/**
 * @param {number} count
 * @param {string} noun in the singular
 * @returns {string} such as "1 point", "2 points"
 */
export const counted = (count, noun) => `${count} ${noun}${count === 1 ? "" : "s"}`;

/**
 * @param {string} id empty for none
 * @param {string} label
 * @param {string} title
 * @param {(event: MouseEvent) => unknown} onclick
 * @returns {HTMLButtonElement}
 */
export const button = (id, label, title, onclick) => element("button", { ...(id && { id }), title, onclick }, label);

/**
 * A choice among options. While a person makes it, what the server says does not change it, see `isHeld`.
 *
 * @param {Record<string, any>} properties
 * @param {(value: string) => unknown} chosen is called with the value of the option that was chosen
 * @param {HTMLOptionElement[]} options
 * @returns {HTMLSelectElement}
 */
export function choice(properties, chosen, ...options) {
  const hold = () => (made.dataset.held = "");
  const leave = () => delete made.dataset.held;
  const change = () => {
    leave();
    chosen(made.value);
  };
  const listeners = { onpointerdown: hold, onkeydown: hold, onblur: leave, onchange: change };
  /** @type {HTMLSelectElement} */
  const made = element("select", { ...properties, ...listeners }, ...options);
  return made;
}

/** @param {HTMLSelectElement} made a choice that may just be made */
export const isHeld = (made) => "held" in made.dataset;

/** @type {Node | null} */
let pressed = null; // what a pointer is pressed on
/** @type {Map<HTMLElement, any[]>} */
const postponed = new Map(); // what elements are to contain after the click

/**
 * Replaces what an element contains; while a pointer is pressed in it, only after the click, which would be lost if
 * the button or the row under it were taken away.
 *
 * @param {HTMLElement} parent
 * @param {any[]} children
 */
export function replaceContent(parent, ...children) {
  if (parent.contains(pressed)) postponed.set(parent, children);
  else parent.replaceChildren(...children);
}

function release() {
  pressed = null;
  for (const [parent, children] of postponed) parent.replaceChildren(...children);
  postponed.clear();
}

document.addEventListener("pointerdown", ({ target }) => (pressed = /** @type {Node} */ (target)), true);
for (const name of ["pointerup", "pointercancel"]) document.addEventListener(name, () => setTimeout(release), true);

// -- messages

// What a page tells a person.
export class Telling {
  /** @type {HTMLElement} */
  messages = element("div", { id: "vtb-messages", role: "status" });

  constructor() {
    document.documentElement.lang = "en"; // Meshcat's page does not say so.
    document.body.append(this.messages);
    document.addEventListener("click", (event) => this.#refuse(event), true);
  }

  /**
   * Lets a button do its work, or grey it with the reason why it cannot; it stays within reach, and tells the reason.
   *
   * @param {HTMLElement} control
   * @param {string} reason empty if it can
   */
  allow(control, reason) {
    control.dataset.does ??= control.title;
    control.title = reason || control.dataset.does;
    control.setAttribute("aria-disabled", String(Boolean(reason)));
  }

  /** @param {MouseEvent} event */
  #refuse(event) {
    const control = event.target instanceof Element ? event.target.closest("[aria-disabled=true]") : null;
    if (!(control instanceof HTMLElement)) return;
    event.preventDefault();
    event.stopPropagation();
    this.say(control.title);
  }

  /**
   * @param {string} kind
   * @returns {HTMLElement | null} the message of a kind
   */
  told(kind) {
    return this.messages.querySelector(`[data-kind="${kind}"]`);
  }

  /**
   * Shows a message for a while; one of a kind replaces the older one and stays until it is taken back. It returns
   * nothing: what asks for something and tells its failure must not take the message for the result.
   *
   * @param {string} text
   */
  say(text, className = "", kind = "") {
    const older = kind ? this.told(kind) : null;
    /** @type {HTMLElement} */
    const shown = older ?? element("p");
    if (!older) this.messages.prepend(shown);
    shown.className = className;
    if (shown.textContent !== text) shown.textContent = text;
    if (kind) shown.dataset.kind = kind;
    else setTimeout(() => shown.remove(), 8000);
  }

  /**
   * @template T
   * @param {Promise<T>} asked
   * @returns {Promise<T | undefined>} its result (null, if it has none); undefined if it was refused, which is told
   */
  async orTell(asked, kind = "") {
    try {
      return await asked;
    } catch (error) {
      this.say(error instanceof Error ? error.message : String(error), "bad", kind);
      return undefined;
    }
  }

  /** @param {string} kind */
  takeBack(kind) {
    this.told(kind)?.remove();
  }

  /**
   * The connection to the server is lost: controls do nothing until it is there again. Then the page begins anew.
   *
   * @param {HTMLElement[]} controls
   */
  lose(...controls) {
    document.body.dataset.session = "lost";
    for (const control of controls) control.inert = true;
    this.say("the connection is lost, or the server has ended: looking for it", "bad", "closed");
    reloadWhenBack(() =>
      this.say("the server has ended, and begun anew: open the address that it has printed", "bad", "closed"),
    );
  }
}

// -- the connection

const RETRY = 1000; // ms between two looks for a server that is lost

/**
 * Looks for the server until it answers, and loads the page anew then: its picture, too, has to begin from nothing.
 *
 * @param {() => void} refused is called where it answers, and knows this page's session no more
 */
async function reloadWhenBack(refused) {
  for (;;) {
    await new Promise((resolve) => setTimeout(resolve, RETRY));
    const answer = await fetch(location.href, { cache: "no-store" }).catch(() => null);
    if (answer?.ok) return location.reload();
    if (answer) refused();
  }
}

export class Connection {
  #socket;
  #number = 0;
  /** @type {Map<number, { resolve: (result: any) => void, reject: (error: Error) => void }>} */
  #waiting = new Map();

  /** @param {{ closed: () => void, [type: string]: (message: any) => unknown }} handlers by the type of a message */
  constructor(handlers) {
    this.#socket = new WebSocket(new URL("session", location.href).href.replace(/^http/, "ws"));
    this.#socket.onmessage = ({ data }) => {
      const message = JSON.parse(data);
      if (message.type !== "answer") return handlers[message.type](message);
      const { resolve, reject } = this.#waiting.get(message.id) ?? {};
      this.#waiting.delete(message.id);
      if (message.error) reject?.(new Error(message.error));
      else resolve?.(message.result);
    };
    this.#socket.onclose = () => {
      for (const { reject } of this.#waiting.values()) reject(new Error("the session has ended"));
      this.#waiting.clear();
      handlers.closed();
    };
  }

  /** The number of the last command. */
  get asked() {
    return this.#number;
  }

  /**
   * Sends a command, as soon as the connection is there.
   *
   * @param {string} command
   * @param {Record<string, any>} fields
   * @returns {Promise<any>} fulfilled with its result when it has been carried out
   */
  ask(command, fields = {}) {
    const id = ++this.#number;
    const socket = this.#socket;
    const send = () => socket.send(JSON.stringify({ id, do: command, ...fields }));
    if (socket.readyState > WebSocket.OPEN)
      return Promise.reject(new Error("the page has no connection to its server"));
    return new Promise((resolve, reject) => {
      this.#waiting.set(id, { resolve, reject });
      if (socket.readyState === WebSocket.OPEN) send();
      else socket.addEventListener("open", send, { once: true });
    });
  }
}

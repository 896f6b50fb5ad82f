// Elements and connection of the pages.

export function element(tag, properties = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (name in made) made[name] = value;
    else made.setAttribute(name, value);
  }
  made.append(...children);
  return made;
}

export function load(tag, properties) {
  return new Promise((resolve, reject) => {
    document.head.append(element(tag, { ...properties, onload: resolve, onerror: reject }));
  });
}

export const number = (value) => (value === null || value === undefined ? "none" : Number(value).toPrecision(5) * 1 + "");

export const button = (id, label, title, onclick) => element("button", { id, title, onclick }, label);

// -- messages

// What a page tells a person.
export class Telling {
  messages = element("div", { id: "vtb-messages", role: "status" });

  constructor() {
    document.body.append(this.messages);
  }

  told(kind) {
    return this.messages.querySelector(`[data-kind="${kind}"]`);
  }

  // Shows a message for a while; one of a kind replaces the older one and stays until it is taken back.
  say(text, className = "", kind = "") {
    let shown = kind && this.told(kind);
    if (!shown) this.messages.prepend((shown = element("p")));
    shown.className = className;
    if (shown.textContent !== text) shown.textContent = text;
    if (kind) shown.dataset.kind = kind;
    else setTimeout(() => shown.remove(), 8000);
    return shown;
  }

  takeBack(kind) {
    this.told(kind)?.remove();
  }
}

// -- the connection

export class Connection {
  #socket;
  #number = 0;
  #waiting = new Map();

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

  // Sends a command; the promise is fulfilled when it has been carried out.
  ask(command, fields = {}) {
    const id = ++this.#number;
    return new Promise((resolve, reject) => {
      this.#waiting.set(id, { resolve, reject });
      this.#socket.send(JSON.stringify({ id, do: command, ...fields }));
    });
  }
}

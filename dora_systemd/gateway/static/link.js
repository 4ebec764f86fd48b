// The connection to the gateway: made again when it breaks, given up while nobody looks.

const FIRST = 1000;
const LONGEST = 30000;
const UNSEEN = 60000;

export class Link {
  /** onMessage: is given each message. onState: "live", or "disconnected" and ms to the next try. */
  constructor(onMessage, onState) {
    this.onMessage = onMessage;
    this.onState = onState;
    this.wait = FIRST;
    this.timer = 0;
    this.unseen = 0;
    document.addEventListener("visibilitychange", () => this.#look());
  }

  connect() {
    clearTimeout(this.timer);
    if (this.socket) return;
    const scheme = location.protocol === "https:" ? "wss:" : "ws:";
    const socket = new WebSocket(`${scheme}//${location.host}/api/live`);
    this.socket = socket;
    socket.onmessage = (event) => this.#take(socket, event.data);
    socket.onclose = () => this.#lost(socket);
  }

  get isLive() {
    return this.socket?.readyState === WebSocket.OPEN;
  }

  send(message) {
    if (this.isLive) this.socket.send(JSON.stringify(message));
  }

  #take(socket, data) {
    if (socket !== this.socket) return;
    const message = JSON.parse(data);
    if (message.type === "hello") {
      this.wait = FIRST;
      this.onState("live");
    }
    this.onMessage(message);
  }

  #lost(socket) {
    if (socket !== this.socket) return;
    this.socket = null;
    if (document.hidden) {
      this.onState("paused");
      return;
    }
    const wait = this.wait * (0.75 + Math.random() / 2);
    this.wait = Math.min(this.wait * 2, LONGEST);
    this.onState("disconnected", wait);
    this.timer = setTimeout(() => this.connect(), wait);
  }

  // The gateway rests when nobody is connected; a page behind others is nobody.
  #look() {
    clearTimeout(this.unseen);
    if (document.hidden) this.unseen = setTimeout(() => this.socket?.close(), UNSEEN);
    else this.connect();
  }
}

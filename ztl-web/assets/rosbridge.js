// A client of rosbridge's protocol that connects again by itself. It never sends anything twice.

const SILENCE = 6000;
const FIRST_PAUSE = 200;
const LONGEST_PAUSE = 1000;

export class Bridge {
  #url;
  #onState;
  #socket = null;
  #pause = FIRST_PAUSE;
  #heard = 0;
  #next = 0;
  #calls = new Map();
  #goals = new Map();
  #topics = new Map();
  #prefix = [...crypto.getRandomValues(new Uint32Array(2))].map((word) => word.toString(36)).join('');

  constructor(url, onState) {
    this.#url = url;
    this.#onState = onState;
    setInterval(() => {
      if (this.#socket && performance.now() - this.#heard > SILENCE) this.#lost(this.#socket);
    }, 1000);
    this.#connect();
  }

  get isOpen() {
    return this.#socket?.readyState === WebSocket.OPEN;
  }

  #connect() {
    const socket = new WebSocket(this.#url);
    this.#socket = socket;
    this.#heard = performance.now();
    socket.onopen = () => {
      this.#pause = FIRST_PAUSE;
      for (const topic of this.#topics.keys()) this.#send({ op: 'subscribe', topic });
      this.#onState(true);
    };
    socket.onclose = () => this.#lost(socket);
    socket.onmessage = (event) => {
      this.#heard = performance.now();
      this.#receive(JSON.parse(event.data));
    };
  }

  // What was asked on this socket has no answer; what was started may run.
  #lost(socket) {
    if (socket !== this.#socket) return;
    this.#socket = null;
    socket.onopen = socket.onclose = socket.onmessage = null;
    socket.close();
    const [calls, goals] = [this.#calls, this.#goals];
    this.#calls = new Map();
    this.#goals = new Map();
    for (const call of calls.values()) call.reject(new Error('the connection was lost before the answer'));
    for (const goal of goals.values()) goal.lost();
    this.#onState(false);
    setTimeout(() => this.#connect(), this.#pause);
    this.#pause = Math.min(this.#pause * 2, LONGEST_PAUSE);
  }

  #send(message) {
    if (!this.isOpen) return false;
    this.#socket.send(JSON.stringify(message));
    return true;
  }

  #receive(message) {
    if (message.op === 'publish') {
      this.#topics.get(message.topic)?.(message.msg);
    } else if (message.op === 'service_response') {
      const call = this.#calls.get(message.id);
      this.#calls.delete(message.id);
      if (message.result) call?.resolve(message.values);
      else call?.reject(new Error(String(message.values)));
    } else if (message.op === 'action_feedback') {
      this.#goals.get(message.id)?.feedback(message.values);
    } else if (message.op === 'action_result') {
      const goal = this.#goals.get(message.id);
      this.#goals.delete(message.id);
      goal?.result(message.result ? message.values : { state: 'NOT_STARTED', text: String(message.values), id: 0 });
    }
  }

  subscribe(topic, tell) {
    this.#topics.set(topic, tell);
    this.#send({ op: 'subscribe', topic });
  }

  unsubscribe(topic) {
    this.#topics.delete(topic);
    this.#send({ op: 'unsubscribe', topic });
  }

  call(service, args) {
    const id = `${this.#prefix}:${++this.#next}`;
    return new Promise((resolve, reject) => {
      if (!this.#send({ op: 'call_service', id, service, args })) {
        reject(new Error('NOT SENT: no connection'));
        return;
      }
      this.#calls.set(id, { resolve, reject });
    });
  }

  // The id of the goal; nothing if it was not sent.
  goal(action, args, watch) {
    const id = `${this.#prefix}:${++this.#next}`;
    const message = { op: 'send_action_goal', id, action, action_type: 'ztl_msgs/action/Task', args, feedback: true };
    if (!this.#send(message)) return undefined;
    this.#goals.set(id, watch);
    return id;
  }

  cancel(id, action) {
    return this.#send({ op: 'cancel_action_goal', id, action });
  }
}

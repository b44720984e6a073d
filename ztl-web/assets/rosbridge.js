// A client of rosbridge's protocol that connects again by itself. It never sends anything twice.

// How long after a press the console may carry it out. What comes later is refused there.
export const LATE = 5000;
const SILENCE = 6000;
const FIRST_PAUSE = 200;
const LONGEST_PAUSE = 500;

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
  // Goals whose connection was lost. The console knows what became of them, unless it was started again.
  #lostGoals = new Map();
  // By this name, a secret, the console finds the goals of this page again.
  #name = [...crypto.getRandomValues(new Uint8Array(16))].map((byte) => byte.toString(16).padStart(2, '0')).join('');
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
      this.#resume();
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
    for (const [id, goal] of goals) {
      this.#lostGoals.set(id, goal);
      goal.lost();
    }
    this.#onState(false);
    setTimeout(() => this.#connect(), this.#pause);
    this.#pause = Math.min(this.#pause * 2, LONGEST_PAUSE);
  }

  // Learns what became of the goals whose connection was lost. Goals that are sent later wait behind this.
  async #resume() {
    const told = await this.call('/ztl/resume', { client: this.#name }).catch(() => null);
    for (const { id, values } of told?.goals ?? []) {
      const goal = this.#lostGoals.get(id);
      if (goal === undefined) continue;
      if (values.state === 'OPEN') {
        this.#goals.set(id, goal);
        goal.open();
      } else {
        goal.result(values);
      }
    }
    // Of the others, nothing will be known.
    if (told !== null) this.#lostGoals.clear();
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
      // The result of a goal that is found again may come before the list of those that are.
      const goal = this.#goals.get(message.id) ?? this.#lostGoals.get(message.id);
      this.#goals.delete(message.id);
      this.#lostGoals.delete(message.id);
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

// Who may start tasks, and how this page takes over.

import { at, setText } from './elements.js';

// How often the operator's page reports that its script runs.
const ALIVE = 1000;

export class Operator {
  #bridge;
  // What the console says of this page: { client, may_operate }; nothing until it is connected.
  #me = null;
  // Who operates: { client, by }; nothing if nobody does.
  #now = null;
  // The number with which this page operates, also while the connection is lost.
  #operates = null;
  // Whether another has taken over from this page.
  #replaced = false;
  #toldAlive = -Infinity;

  constructor(bridge) {
    this.#bridge = bridge;
    at('take-over').addEventListener('click', () => this.#take({ from: this.#now?.client }));
  }

  get mayOperate() {
    return this.#me?.may_operate ?? true;
  }

  // The connection is there. If this page operated before, it goes on, unless another has taken over.
  async welcome(told) {
    this.#now = told.operator ?? null;
    if (this.#operates !== null && told.may_operate) await this.#take({ from: this.#operates });
    this.#me = told;
    this.#tellAlive();
    this.see(this.#now);
  }

  gone() {
    this.#me = null;
    this.#show();
  }

  // The console says who operates.
  see(now) {
    this.#now = now ?? null;
    if (this.#me === null) return;
    const mine = this.#now?.client === this.#me.client;
    this.#replaced = !mine && this.#now !== null && (this.#replaced || this.#operates !== null);
    this.#operates = mine ? this.#me.client : null;
    if (mine && performance.now() - this.#toldAlive >= ALIVE) this.#tellAlive();
    this.#show();
  }

  // Reports that the script of this page runs. Called for messages of the console, which arrive at least every 2 s, and not
  // by a timer: browsers slow down the timers of a tab in the background.
  #tellAlive() {
    this.#toldAlive = performance.now();
    this.#bridge.call('/ztl/alive', {}).catch(() => {});
  }

  // Why this page may start nothing; empty if it may.
  whyNot() {
    if (this.#me === null) return 'No connection.';
    if (!this.#me.may_operate) return 'A watcher looks and stops.';
    if (this.#now !== null && this.#now.client !== this.#me.client) return `${this.#now.by} operates: take over to start.`;
    return '';
  }

  async #take(from) {
    try {
      this.see((await this.#bridge.call('/ztl/operate', from)).operator);
      setText(at('form-said'), '');
    } catch (error) {
      setText(at('form-said'), `NOT TAKEN OVER: ${error.message}`);
    }
  }

  #show() {
    const said = at('operator');
    const mine = this.#operates !== null;
    const other = this.#me !== null && !mine && this.#now !== null;
    if (this.#me === null) setText(said, '');
    else if (mine) setText(said, `You operate. Others see ${this.#now.by}.`);
    else if (!other) setText(said, 'Nobody operates.');
    else setText(said, `${this.#now.by} ${this.#replaced ? 'has taken over' : 'operates'}.`);
    said.classList.toggle('bad', other && this.#replaced);
    at('take-over').hidden = !other || !this.#me.may_operate;
    at('do').hidden = !this.mayOperate;
  }
}

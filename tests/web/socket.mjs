// A client of /rosbridge that is as odd as it likes: node socket.mjs SCENARIO URL [DIRECTORY].

import assert from 'node:assert/strict';
import { createRequire } from 'node:module';
import { createInterface } from 'node:readline';

const [scenario, url] = process.argv.slice(2);
const require = createRequire(`${process.env.ZTL_CLIENTS}/`);
const { WebSocket } = require('ws');
const lines = createInterface({ input: process.stdin })[Symbol.asyncIterator]();

class Client {
  constructor(where = url) {
    this.heard = [];
    this.socket = new WebSocket(where);
    this.closed = new Promise((done) => this.socket.on('close', done));
    this.socket.on('error', () => {});
    this.socket.on('message', (data) => { this.heard.push(JSON.parse(data)); this.wake?.(); });
  }

  async open() {
    await new Promise((done) => this.socket.on('open', done));
    return this;
  }

  send(message) {
    this.socket.send(typeof message === 'string' ? message : JSON.stringify(message));
  }

  // The first message that fits, taken from what was heard.
  async next(fits) {
    for (;;) {
      const at = this.heard.findIndex(fits);
      if (at >= 0) return this.heard.splice(at, 1)[0];
      await new Promise((done) => { this.wake = done; });
    }
  }

  goal(id, component, goal, prefix = '/test') {
    this.send({ op: 'send_action_goal', id, action: `${prefix}/${component}`, args: { goal }, feedback: true });
  }

  result(id) {
    return this.next((message) => message.op === 'action_result' && message.id === id);
  }

  async call(service, args = {}) {
    this.send({ op: 'call_service', id: service, service, args });
    return this.next((message) => message.op === 'service_response' && message.id === service);
  }

  task(fits) {
    this.send({ op: 'subscribe', topic: '/ztl/tasks' });
    return this.next((message) => message.topic === '/ztl/tasks' && message.msg.tasks.some(fits));
  }
}

const scenarios = {
  // Goals of a client that goes away go on, unless it has chosen otherwise.
  async gone() {
    const watching = await new Client().open();
    const runs = (goal, is) => (task) => task.task === `test:sleep:${goal}` && task.runs === is;
    for (const [goal, abort] of [['70', false], ['71', true]]) {
      const client = await new Client().open();
      assert.equal((await client.call('/ztl/operate')).result, true);
      if (abort) assert.equal((await client.call('/ztl/when_gone', { abort })).result, true);
      client.goal('g', 'test/sleep', goal);
      await watching.task(runs(goal, true));
      client.socket.terminate();
    }
    const both = (tasks) => tasks.some(runs('71', false)) && tasks.some(runs('70', true));
    await watching.next((message) => message.topic === '/ztl/tasks' && both(message.msg.tasks));
  },

  // What is malformed is answered or ends the socket, and harms no other client.
  async garbage() {
    const other = await new Client().open();
    const client = await new Client().open();
    for (const text of ['', '[]', '{', '{"op":"advertise"}', '{"op":"subscribe","topic":"/x"}', '[' .repeat(9000)]) {
      client.send(text);
      assert.equal((await client.next((message) => message.op === 'status')).level, 'error', text);
    }
    client.send(Buffer.from([0xff, 0xfe]));
    await client.next((message) => message.op === 'status');
    for (const action of ['', '/', '/test', '/test/', '/other/a/b', '/test//x']) {
      client.send({ op: 'send_action_goal', id: action, action, args: { goal: '1' } });
      assert.equal((await client.result(action)).result, false, action);
    }
    client.send({ op: 'send_action_goal', id: 'long', action: '/test/test/echo', args: { goal: 'x'.repeat(70_000) } });
    await client.closed;
    other.goal('after', 'test/echo', 'there');
    assert.equal((await other.result('after')).values.text, 'there');
  },

  // Too many goals are refused; the same id starts one goal; a Stop and a cancel come through.
  async many() {
    const client = await new Client().open();
    client.goal('same', 'test/mark', 'x');
    client.goal('same', 'test/mark', 'x');
    assert.match((await client.result('same')).values, /not sent again/);
    for (let number = 0; number < 300; number += 1) client.goal(`n${number}`, 'test/echo', 'x');
    const results = [];
    for (let number = 0; number < 300; number += 1) results.push(await client.result(`n${number}`));
    const refused = results.filter((message) => !message.result);
    assert.ok(refused.length > 200 && refused.every((message) => /too many|are open/.test(message.values)));
    client.send({ op: 'cancel_action_goal', id: 'same', action: '/test/test/mark' });
    assert.equal((await client.result('same')).values.state, 'ABORTED');
    assert.equal((await client.call('/ztl/stop')).values.robots[0].confirmed, true);
  },

  // Long messages count more; beyond the limit each goal is refused unread, and Stop comes through. No answer repeats a long name.
  async large() {
    const client = await new Client().open();
    const args = { goal: 'x', more: Array(15_000).fill([1]) };
    const ids = Array.from({ length: 100 }, (_, number) => `n${number}`);
    for (const id of ids) client.send({ op: 'send_action_goal', id, action: '/test/test/echo', args });
    const results = [];
    for (const id of ids) results.push(await client.result(id));
    assert.ok(results.some((message) => /^too many messages/.test(message.values)));
    assert.equal((await client.call('/ztl/stop')).values.robots[0].confirmed, true);
    const other = await new Client().open();
    const long = 'x'.repeat(3000);
    for (const message of [
      { op: 'subscribe', topic: long }, { op: 'cancel_action_goal', id: long, action: '/test/test/echo' },
      { op: 'send_action_goal', id: 'g', action: long }, { op: 'call_service', id: [long], service: '/ztl/time' },
    ]) {
      other.send(message);
      assert.match((await other.next((told) => told.op === 'status')).msg, /longer than 2048 bytes/);
    }
  },

  // A watcher looks and stops, and starts nothing.
  async watcher() {
    const client = await new Client().open();
    client.goal('g', 'test/echo', 'x');
    assert.match((await client.result('g')).values, /may only look and stop/);
    assert.match((await client.call('/ztl/operate')).values, /may only look and stop/);
    const told = (await client.call('/ztl/robots')).values;
    assert.deepEqual([told.may_operate, told.operator], [false, null]);
    assert.ok((await client.call('/ztl/tasks')).values.tasks);
    assert.match((await client.call('/ztl/stop')).values.by, /^watcher \d+ at 127.0.0.1$/);
    assert.match((await client.call('/ztl/abort', { robot: 'ours', scope: '/test', id: 1 })).values, /may still run/);
  },

  // One client at a time starts tasks. Each may take over, sees who did, and stops the tasks of all.
  async operators() {
    const [one, other, third] = await Promise.all([1, 2, 3].map(() => new Client().open()));
    const operates = (client) => other.next((message) => message.topic === '/ztl/robots' && message.msg.operator?.client === client);
    const number = async (client) => (await client.call('/ztl/robots')).values.client;
    const numbers = [await number(one), await number(other), await number(third)];
    assert.equal(new Set(numbers).size, 3);
    other.send({ op: 'subscribe', topic: '/ztl/robots' });
    one.goal('g', 'test/sleep', '60');
    await operates(numbers[0]);
    other.goal('h', 'test/mark', 'x');
    assert.match((await other.result('h')).values, /^operator \d+ at 127.0.0.1 operates: take over/);
    assert.equal((await other.call('/ztl/operate', { from: numbers[0] })).values.operator.client, numbers[1]);
    await operates(numbers[1]);
    // Too late: it saw the one before.
    assert.match((await third.call('/ztl/operate', { from: numbers[0] })).values, /has taken over before/);
    assert.match((await third.call('/ztl/operate', { from: 'me' })).values, /expected/);
    one.goal('i', 'test/mark', 'x');
    assert.match((await one.result('i')).values, /operates: take over/);
    // What it started goes on; also others may end it.
    const { msg } = await third.task((task) => task.task === 'test:sleep:60' && task.runs);
    const { robot, scope, id } = msg.tasks.find((task) => task.runs);
    assert.equal((await third.call('/ztl/abort', { robot, scope, id })).values.state, 'ABORTED');
    assert.equal((await one.result('g')).values.state, 'ABORTED');
    other.socket.terminate();
    const free = (message) => message.topic === '/ztl/robots' && message.msg.operator === null;
    third.send({ op: 'subscribe', topic: '/ztl/robots' });
    await third.next(free);
    third.goal('j', 'test/echo', 'x');
    assert.equal((await third.result('j')).values.state, 'COMPLETED');
  },

  // A server of the original lists nothing: its goals are known, and Stop does not call it confirmed.
  async original() {
    const client = await new Client().open();
    client.goal('g', 'test/sleep', '10');
    const told = await client.task((task) => task.task === 'test:sleep:10');
    assert.match(told.msg.gaps[0].text, /does not list its tasks/);
    const [robot] = (await client.call('/ztl/stop')).values.robots;
    assert.equal(robot.confirmed, false);
    assert.match(robot.text, /1 of this console were asked to stop/);
    assert.equal((await client.result('g')).values.state, 'COMPLETED');
  },

  // A server that hangs is named by Stop, in bounded time, and delays no answer about the others.
  async hanging() {
    const client = await new Client().open();
    client.goal('g', 'test/sleep', '60', 'ours:/test');
    await client.task((task) => task.task === 'test:sleep:60' && task.runs);
    client.send({ op: 'subscribe', topic: '/ztl/stop' });
    client.send({ op: 'call_service', id: 'stop', service: '/ztl/stop' });
    const by = (robot, confirmed) => (message) => message.topic === '/ztl/stop'
      && message.msg.robots.some((of) => of.robot === robot && of.confirmed === confirmed);
    const first = await client.next(by('ours', true));
    assert.ok(by('hangs', null)(first));
    assert.equal((await client.result('g')).values.state, 'ABORTED');
    const told = await client.next((message) => message.id === 'stop');
    assert.equal(told.values.robots.find((of) => of.robot === 'hangs').confirmed, false);
  },

  // The server is killed while a task runs: its outcome is unknown, and it is not started again.
  async unknown() {
    const client = await new Client().open();
    client.goal('g', 'test/mark', 'x');
    await client.task((task) => task.task === 'test:mark:x' && task.runs);
    console.log('do: restart the server');
    await lines.next();
    assert.equal((await client.result('g')).values.state, 'UNKNOWN');
    client.goal('h', 'test/echo', 'there');
    assert.equal((await client.result('h')).values.text, 'there');
  },
};

await scenarios[scenario]();
console.log('passed');
process.exit(0);

// The unmodified roslib as a client: node roslib.mjs URL.

import assert from 'node:assert/strict';
import { pathToFileURL } from 'node:url';

const roslib = `${process.env.ZTL_CLIENTS}/node_modules/roslib/dist/RosLib.js`;
const { Ros, Action, Service, Topic } = await import(pathToFileURL(roslib));

const ros = new Ros({ url: process.argv[2] });
await new Promise((done, failed) => { ros.on('connection', done); ros.on('error', failed); });
const action = (name) => new Action({ ros, name: `/test/${name}`, actionType: 'ztl_msgs/action/Task' });
// How a goal ends, and its progress.
function run(goals, goal, act = () => {}) {
  const progress = [];
  return new Promise((done) => {
    const failed = (why) => done({ failed: why, progress });
    const id = goals.sendGoal({ goal }, (result) => done({ result, progress }), (told) => progress.push(told.progress), failed);
    act(id);
  });
}
const call = (name, args) => new Promise((done, failed) => {
  new Service({ ros, name, serviceType: 'ztl_msgs/srv/Any' }).callService(args, done, failed);
});

const echo = await run(action('test/echo'), 'hi');
assert.deepEqual([echo.result.state, echo.result.text], ['COMPLETED', 'hi']);
assert.ok(echo.result.id > 0);
const robots = await call('/ztl/robots', {});
assert.equal(robots.robots[0].name, 'ours');

// A cancel does not wait behind a goal that runs, and tells the final state.
const sleep = action('test/sleep');
const first = run(sleep, '60');
const second = await run(sleep, '61', (id) => sleep.cancelGoal(id));
assert.match(second.failed, /ABORTED|NOT_STARTED/);

const listed = await new Promise((done) => {
  const topic = new Topic({ ros, name: '/ztl/tasks', messageType: 'ztl_msgs/msg/Tasks' });
  topic.subscribe((told) => {
    const found = told.tasks.find((task) => task.task === 'test:sleep:60' && task.runs);
    if (found) done(found);
  });
});
const aborted = await call('/ztl/abort', { robot: listed.robot, scope: listed.scope, id: listed.id });
assert.equal(aborted.state, 'ABORTED');
assert.match((await first).failed, /ABORTED/);

const wrong = await run(action('test'), 'x');
assert.match(wrong.failed, /no action/);
await assert.rejects(call('/ztl/nothing', {}), /no service/);
const stopped = await call('/ztl/stop', {});
assert.equal(stopped.robots[0].confirmed, true);
console.log('passed');
process.exit(0);

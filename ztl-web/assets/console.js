// The page: shows what the topics say, and sends goals, aborts and Stop. It uses nothing but /rosbridge.

import { at, card, element, setText, showAll, span } from './elements.js';
import { Form, NOTHING } from './form.js';
import { Operator } from './operator.js';
import { Past } from './past.js';
import { showRobots } from './robots.js';
import { Bridge } from './rosbridge.js';
import { Show } from './show.js';
import { Streams } from './streams.js';

// How long ago a Stop may have ended that a page shows which was not there.
const RECENT = 10_000;
// A press on a card that has moved since was meant for another one.
const MOVED = 600;
// How often the console's clock is asked for.
const CLOCK = 10_000;

let robots = [];
let tasks = { tasks: [], gaps: [] };
// The last Stop whose answers are known.
let lastStop = null;
let closedStop = sessionStorage.getItem('closed-stop');
// The console's wall clock, and this browser's monotonic clock when the console told it. The wall clock of this
// browser may be wrong, or be set while the page is open.
let clock = null;
// Whether the page has heard that Esc was pressed, and not yet that it is up again.
let escIsDown = false;

const bridge = new Bridge(`${location.protocol.replace('http', 'ws')}//${location.host}/rosbridge`, onState);
const operator = new Operator(bridge);
const form = new Form(bridge, { now, whyNot: () => operator.whyNot(), started });
const streams = new Streams(bridge, now);
const past = new Past(bridge);
const stage = new Show(bridge, { now, whyNot: () => operator.whyNot(), recorded: (is) => past.showRecord(is) });

// The console's wall clock. Behind by what the answer took to come, never ahead.
function now() {
  return clock === null ? Date.now() : Math.round(clock.ms + performance.now() - clock.at);
}

async function askClock() {
  const told = await bridge.call('/ztl/robots', {});
  clock = { ms: told.now_ms, at: performance.now() };
  return told;
}

function onState(open) {
  at('connection').dataset.state = open ? 'open' : 'lost';
  if (open) {
    greet().catch(() => {});
  } else {
    operator.gone();
    askWhy();
  }
  show();
}

async function greet() {
  await operator.welcome(await askClock());
  chooseWhenGone();
  // Only now: whether a Stop is old depends on the console's clock.
  bridge.subscribe('/ztl/stop', showStop);
  show();
}

// What happens to the goals of this page when it is closed, or loses its connection: they go on, or are aborted.
function chooseWhenGone() {
  const abort = at('when-gone').checked;
  bridge.call('/ztl/when_gone', { abort }).catch((error) => {
    at('when-gone').checked = false;
    setText(at('form-said'), `NOT CHOSEN: ${error.message}`);
  });
}
at('when-gone').addEventListener('change', chooseWhenGone);

// A socket does not tell why it was refused; a file does.
async function askWhy() {
  const answer = await fetch('/style.css', { cache: 'no-store' }).catch(() => null);
  if (answer?.status === 401) setText(at('connection'), 'No access: open the link again that ztl web printed');
}

bridge.subscribe('/ztl/robots', (told) => {
  robots = told.robots;
  operator.see(told.operator);
  form.offer(robots);
  streams.offer(told.publishers);
  show();
});
bridge.subscribe('/ztl/tasks', (told) => { tasks = told; past.look(); showSoon(); });
setInterval(show, 1000);
setInterval(() => { if (bridge.isOpen) askClock().catch(() => {}); }, CLOCK);

let showsSoon = false;

// Runs once for each frame that the browser paints, and not while the page is hidden.
function showSoon() {
  if (showsSoon) return;
  showsSoon = true;
  requestAnimationFrame(() => { showsSoon = false; showNow(); });
}

// What tasks change, which they do many times a second.
function showNow() {
  showConnection();
  showTasks();
  if (lastStop && !at('stopped').hidden) showVerdict(lastStop);
}
at('ended-box').addEventListener('toggle', showNow);

function show() {
  showNow();
  showRobots(robots, now());
  form.show();
  stage.show();
  streams.show();
}

function showConnection() {
  const missing = robots.filter((robot) => robot.health === 'missing').length;
  const words = [operator.mayOperate ? 'connected' : 'connected, as a watcher'];
  const running = tasks.tasks.filter((task) => task.runs).length;
  if (running) words.push(`${running} running`);
  if (missing) words.push(`${missing} of ${robots.length} missing`);
  const lost = 'No connection to the console: what is shown is old';
  const said = at('connection');
  if (bridge.isOpen) setText(said, words.join(' · '));
  else if (!said.textContent.startsWith('No ')) setText(said, lost);
}

// A goal was sent: what was confirmed before says nothing of it.
function started() {
  hideStop();
}

function hideStop() {
  at('stopped').hidden = true;
  setText(at('stopped-before'), '');
}

function ago(ms) {
  return span(now() - ms);
}

function showTasks() {
  const missing = new Set(robots.filter((robot) => robot.health === 'missing').map((robot) => robot.name));
  // The latest below the others, so that a start moves no button under a thumb.
  const running = tasks.tasks.filter((task) => task.runs).reverse();
  const key = (task) => JSON.stringify([task.robot, task.scope, task.id]);
  const buttons = [['Abort', (made, button) => abort(made, button)]];
  const update = (made, task) => {
    const [name, text, about] = made.lines;
    made.task = task;
    const place = running.indexOf(task);
    if (made.place !== place) made.moved = made.place === undefined ? made.moved : performance.now();
    made.place = place;
    setText(name, task.task || `task ${task.id}`);
    const said = task.text === NOTHING ? '' : task.text;
    setText(text, task.runs ? said : `${task.state} ${said}`);
    const since = task.started_ms === null ? '' : `started ${ago(task.started_ms)} ago`;
    const stale = missing.has(task.robot) ? 'the robot is missing: last known' : '';
    const by = task.by ? `by ${task.by}` : '';
    setText(about, [`${task.robot} ${task.scope} ${task.id}`, by, since, stale].filter(Boolean).join(' · '));
    for (const button of made.buttons) {
      button.disabled = !bridge.isOpen || 'busy' in button.dataset;
      button.setAttribute('aria-label', `Abort ${task.task || task.id} of ${task.robot}`);
    }
  };
  const ended = tasks.tasks.filter((task) => !task.runs);
  const lines = ['name', '', 'quiet'];
  showAll(at('running'), running, key, () => card(lines, buttons), update);
  if (at('ended-box').open) showAll(at('ended'), ended, key, () => card(lines, []), update);
  at('ended-box').hidden = ended.length === 0;
  at('idle').hidden = running.length > 0;
  setText(at('idle'), missing.size || tasks.gaps.length ? 'No running task is known.' : 'No task is running.');
  showAll(at('gaps'), tasks.gaps, (gap) => JSON.stringify(gap), () => element('li', 'bad'),
    (made, gap) => setText(made, `${gap.robot}: ${gap.text}`));
}

function abort(made, button) {
  const task = made.task;
  if (performance.now() - (made.moved ?? -Infinity) < MOVED) {
    setText(at('abort-said'), `NOT SENT: the list moved as you pressed. Press again to abort task ${task.id}.`);
    return;
  }
  button.dataset.busy = '';
  show();
  const done = (text) => {
    delete button.dataset.busy;
    setText(at('abort-said'), text);
    show();
  };
  bridge.call('/ztl/abort', { robot: task.robot, scope: task.scope, id: task.id }).then(
    (told) => done(`task ${task.id}: ${told.state}, ${told.text}`),
    (error) => done(`task ${task.id}: ${error.message}`),
  );
}

function stop() {
  closedStop = null;
  // What the Stop before has said stays.
  const before = at('stopped').hidden || !lastStop ? [] : [at('stopped-title'), ...at('confirmations').children];
  setText(at('stopped-before'), before.length ? `Before: ${before.map((said) => said.textContent).join(' · ')}` : '');
  lastStop = null;
  at('stopped').hidden = false;
  setText(at('stopped-title'), 'Stop: sent, no robot has confirmed yet');
  at('confirmations').replaceChildren();
  bridge.call('/ztl/stop', {}).then(showStop, (error) => {
    setText(at('stopped-title'), `Stop: ${error.message}. No robot has confirmed. Use the stop of the robot itself.`);
    at('confirmations').replaceChildren();
  });
}

function showStop(told) {
  if (!told.robots || String(told.at_ms) === closedStop) return;
  const waits = told.robots.some((robot) => robot.confirmed === null);
  if (!waits && at('stopped').hidden && now() - told.at_ms > RECENT) return;
  at('stopped').hidden = false;
  at('stopped').dataset.at = told.at_ms;
  lastStop = told;
  showVerdict(told);
}

// What confirmed once says nothing of a task that runs now.
function showVerdict(told) {
  const waits = told.robots.some((robot) => robot.confirmed === null);
  const all = told.robots.every((robot) => robot.confirmed);
  const again = all && tasks.tasks.some((task) => task.runs);
  const time = new Date(told.at_ms).toLocaleTimeString();
  const confirmed = again ? 'Every robot had confirmed, but tasks run again' : 'Stopped: every robot has confirmed';
  const title = waits ? 'Stop under way' : all ? confirmed : 'NOT every robot has confirmed';
  setText(at('stopped-title'), `${title} (${told.by}, ${time})`);
  // First what a person has to act on.
  const urgent = (robot) => (robot.confirmed === false ? 0 : robot.confirmed === null ? 1 : 2);
  const sorted = [...told.robots].sort((one, other) => urgent(one) - urgent(other));
  showAll(at('confirmations'), sorted, (robot) => robot.robot, () => element('li'), (made, robot) => {
    made.className = again ? 'quiet' : robot.confirmed ? 'good' : robot.confirmed === null ? 'quiet' : 'bad';
    const word = robot.confirmed ? 'confirmed' : robot.confirmed === null ? 'waiting' : 'NOT CONFIRMED';
    setText(made, `${robot.robot}: ${word}: ${robot.text}`);
  });
}

at('stop').addEventListener('click', stop);
at('stopped-close').addEventListener('click', () => {
  closedStop = at('stopped').dataset.at;
  sessionStorage.setItem('closed-stop', closedStop);
  hideStop();
  at('stop').focus();
});
addEventListener('keydown', (event) => {
  if (event.key !== 'Escape') return;
  escIsDown = true;
  event.preventDefault();
  if (!event.repeat) stop();
});
// While the list of components is open, browsers close it with Esc, and tell the page only that the key is up again.
addEventListener('keyup', (event) => {
  if (event.key !== 'Escape') return;
  if (!escIsDown && document.activeElement === at('component')) stop();
  escIsDown = false;
});
addEventListener('blur', () => { escIsDown = false; });

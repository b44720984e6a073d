// The page: shows what the topics say, and sends goals, aborts and Stop. It uses nothing but /rosbridge.

import { at, card, element, setText, short, showAll, span } from './elements.js';
import { Bridge } from './rosbridge.js';

const KEPT_GOALS = 20;
const OTHER = '*';
// What a server says of a task without progress or result.
const NOTHING = 'None';
// How long ago a Stop may have ended that a page shows which was not there.
const RECENT = 10_000;
// How soon after a goal the same one is taken for a second press of the same kind, such as a double click.
const SAME_PRESS = 700;

let robots = [];
let tasks = { tasks: [], gaps: [] };
let mayOperate = false;
let goals = [];
let closedStop = sessionStorage.getItem('closed-stop');
// How far the console's wall clock is ahead of this browser's.
let ahead = 0;

const bridge = new Bridge(`${location.protocol.replace('http', 'ws')}//${location.host}/rosbridge`, onState);

function onState(open) {
  const connection = at('connection');
  connection.dataset.state = open ? 'open' : 'lost';
  if (open) {
    bridge.call('/ztl/robots', {}).then((told) => {
      mayOperate = told.may_operate;
      ahead = told.now_ms - Date.now();
      // Only now: whether a Stop is old depends on the console's clock.
      bridge.subscribe('/ztl/stop', showStop);
      showForm();
      show();
    }, () => {});
  }
  show();
}

bridge.subscribe('/ztl/robots', (told) => { robots = told.robots; showForm(); show(); });
bridge.subscribe('/ztl/tasks', (told) => { tasks = told; show(); });
setInterval(show, 1000);

function show() {
  showConnection();
  showRobots();
  showTasks();
  showGoals();
  const may = mayOperate && bridge.isOpen;
  at('start').disabled = !may;
  // Never disabled without a connection: a press then says that nothing was sent.
  at('stop').disabled = bridge.isOpen && !mayOperate;
}

function showConnection() {
  const missing = robots.filter((robot) => robot.health === 'missing').length;
  const words = [mayOperate ? 'connected' : 'connected, as a watcher'];
  if (missing) words.push(`${missing} of ${robots.length} missing`);
  setText(at('connection'), bridge.isOpen ? words.join(' · ') : 'No connection to the console: what is shown is old');
}

function ago(ms) {
  return span(Date.now() + ahead - ms);
}

function showRobots() {
  const words = { there: 'there', missing: 'MISSING', unknown: 'not asked yet' };
  showAll(at('robot-list'), robots, (robot) => robot.name, () => card(['name', '', 'quiet'], []), (made, robot) => {
    const [name, health, text] = made.lines;
    setText(name, robot.name);
    health.className = { there: 'good', missing: 'bad' }[robot.health] ?? 'quiet';
    const since = robot.health === 'unknown' ? '' : ` for ${ago(robot.since_ms)}`;
    setText(health, words[robot.health] + since);
    setText(text, [robot.endpoint, robot.text].filter(Boolean).join('\n'));
  });
}

function showTasks() {
  const missing = new Set(robots.filter((robot) => robot.health === 'missing').map((robot) => robot.name));
  const key = (task) => JSON.stringify([task.robot, task.scope, task.id]);
  const buttons = [['Abort', (made, button) => abort(made.task, button)]];
  const update = (made, task) => {
    const [name, text, about] = made.lines;
    made.task = task;
    setText(name, task.task || `task ${task.id}`);
    const said = task.text === NOTHING ? '' : task.text;
    setText(text, task.runs ? said : `${task.state} ${said}`);
    const since = task.started_ms === null ? '' : `started ${ago(task.started_ms)} ago`;
    const stale = missing.has(task.robot) ? 'the robot is missing: last known' : '';
    const by = task.by ? `by ${task.by}` : '';
    setText(about, [`${task.robot} ${task.scope} ${task.id}`, by, since, stale].filter(Boolean).join(' · '));
    for (const button of made.buttons) {
      button.disabled = !(mayOperate && bridge.isOpen) || 'busy' in button.dataset;
      button.setAttribute('aria-label', `Abort ${task.task || task.id} of ${task.robot}`);
    }
  };
  const running = tasks.tasks.filter((task) => task.runs);
  const ended = tasks.tasks.filter((task) => !task.runs);
  const lines = ['name', '', 'quiet'];
  showAll(at('running'), running, key, () => card(lines, buttons), update);
  showAll(at('ended'), ended, key, () => card(lines, []), update);
  at('ended-box').hidden = ended.length === 0;
  at('idle').hidden = running.length > 0;
  setText(at('idle'), missing.size || tasks.gaps.length ? 'No running task is known.' : 'No task is running.');
  showAll(at('gaps'), tasks.gaps, (gap) => JSON.stringify(gap), () => element('li', 'bad'),
    (made, gap) => setText(made, `${gap.robot}: ${gap.text}`));
}

function abort(task, button) {
  button.dataset.busy = '';
  show();
  const done = (text) => {
    delete button.dataset.busy;
    setText(at('form-said'), text);
    show();
  };
  bridge.call('/ztl/abort', { robot: task.robot, scope: task.scope, id: task.id }).then(
    (told) => done(`task ${task.id}: ${told.state}, ${told.text}`),
    (error) => done(`task ${task.id}: ${error.message}`),
  );
}

// One choice for each component that a robot tells, and one for any other of its scope.
function choices() {
  const all = [];
  for (const robot of robots) {
    for (const scope of robot.scopes) {
      const names = Object.entries(scope.handlers ?? {})
        .flatMap(([handler, components]) => components.map((component) => [handler, component]))
        .filter((pair) => !pair.includes(OTHER));
      for (const [handler, component] of names) {
        all.push([robot.name, JSON.stringify([scope.action, handler, component]), `${handler} ${component}`]);
      }
      all.push([robot.name, JSON.stringify([scope.action]), `another of ${scope.action} …`]);
    }
  }
  return all;
}

let shownChoices = '';
function showForm() {
  const all = choices();
  const now = JSON.stringify(all);
  if (now === shownChoices) return;
  shownChoices = now;
  const select = at('component');
  const chosen = select.value;
  const groups = new Map();
  for (const [robot, value, text] of all) {
    if (!groups.has(robot)) {
      const group = element('optgroup');
      group.label = robot;
      groups.set(robot, group);
    }
    const option = element('option', '', text);
    option.value = value;
    groups.get(robot).append(option);
  }
  select.replaceChildren(...groups.values());
  if (all.some(([, value]) => value === chosen)) select.value = chosen;
  showOther();
}

function showOther() {
  const value = at('component').value;
  at('other-box').hidden = !value || JSON.parse(value).length > 1;
}
at('component').addEventListener('change', showOther);

at('form').addEventListener('submit', (event) => {
  event.preventDefault();
  const value = at('component').value;
  if (!value || !mayOperate) return;
  const [prefix, handler, component] = JSON.parse(value);
  const name = handler === undefined ? at('other').value : `${handler}/${component}`;
  start(`${prefix}/${name}`, name, at('goal').value);
});

// A held Enter submits again and again.
at('form').addEventListener('keydown', (event) => {
  if (event.key === 'Enter' && event.repeat) event.preventDefault();
});

function start(action, name, text) {
  const [last] = goals;
  if (last?.action === action && last.text === text
    && (last.state === 'sent' || performance.now() - last.pressed < SAME_PRESS)) {
    setText(at('form-said'), 'not sent again: the same goal was just sent');
    return;
  }
  const goal = { action, name, text, state: 'sent', progress: '', ended: false, pressed: performance.now() };
  goal.id = bridge.goal(action, text, {
    feedback: (told) => { goal.state = 'running'; goal.progress = told.progress; showGoals(); },
    result: (told) => { goal.state = told.state; goal.progress = told.text; goal.ended = true; showGoals(); },
    lost: () => {
      goal.state = 'UNKNOWN';
      goal.progress = 'the connection was lost: if it runs, Now shows it; it is not sent again';
      goal.ended = true;
      showGoals();
    },
  });
  if (goal.id === undefined) {
    setText(at('form-said'), 'NOT SENT: no connection');
    return;
  }
  setText(at('form-said'), '');
  // What was confirmed before says nothing of this goal.
  at('stopped').hidden = true;
  goals = [goal, ...goals].slice(0, KEPT_GOALS);
  showGoals();
}

function showGoals() {
  at('goals-title').hidden = goals.length === 0;
  const again = (made) => {
    at('goal').value = made.goal.text;
    choose(made.goal);
    at('goal').focus();
  };
  const cancel = (made) => {
    made.goal.progress = 'abort sent';
    if (!bridge.cancel(made.goal.id, made.goal.action)) made.goal.progress = 'abort NOT SENT: no connection';
    showGoals();
  };
  const make = () => card(['name', '', 'quiet'], [['Abort', cancel], ['Again', again]]);
  showAll(at('goals'), goals, (goal) => goal.id, make, (made, goal) => {
    made.goal = goal;
    const [name, said] = made.lines;
    setText(name, short(`${goal.name} ${goal.text}`));
    said.className = goal.state === 'COMPLETED' ? 'good' : goal.ended ? 'bad' : '';
    setText(said, short([goal.state, goal.progress].filter((text) => text && text !== NOTHING).join(': ')));
    const [abortButton, againButton] = made.buttons;
    abortButton.hidden = goal.ended;
    againButton.hidden = !goal.ended;
    abortButton.setAttribute('aria-label', `Abort ${goal.name} ${goal.text}`);
    againButton.setAttribute('aria-label', `Again ${goal.name} ${goal.text}: fill in the form`);
  });
}

// Chooses the component of an earlier goal in the form.
function choose(goal) {
  const whole = ([prefix, ...names]) => [prefix, ...names].join('/');
  const options = [...at('component').options].map((option) => option.value);
  const same = options.find((value) => whole(JSON.parse(value)) === goal.action)
    ?? options.find((value) => JSON.parse(value).length === 1 && goal.action.startsWith(`${JSON.parse(value)[0]}/`));
  if (same === undefined) return;
  at('component').value = same;
  at('other').value = goal.name;
  showOther();
}

function stop() {
  if (bridge.isOpen && !mayOperate) return;
  closedStop = null;
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
  if (!waits && at('stopped').hidden && Date.now() + ahead - told.at_ms > RECENT) return;
  const all = told.robots.every((robot) => robot.confirmed);
  at('stopped').hidden = false;
  at('stopped').dataset.at = told.at_ms;
  const time = new Date(told.at_ms).toLocaleTimeString();
  const title = waits ? 'Stop under way' : all ? 'Stopped: every robot has confirmed' : 'NOT every robot has confirmed';
  setText(at('stopped-title'), `${title} (${told.by}, ${time})`);
  showAll(at('confirmations'), told.robots, (robot) => robot.robot, () => element('li'), (made, robot) => {
    made.className = robot.confirmed ? 'good' : robot.confirmed === null ? 'quiet' : 'bad';
    const word = robot.confirmed ? 'confirmed' : robot.confirmed === null ? 'waiting' : 'NOT CONFIRMED';
    setText(made, `${robot.robot}: ${word}: ${robot.text}`);
  });
}

at('stop').addEventListener('click', stop);
at('stopped-close').addEventListener('click', () => {
  closedStop = at('stopped').dataset.at;
  sessionStorage.setItem('closed-stop', closedStop);
  at('stopped').hidden = true;
  at('stop').focus();
});
addEventListener('keydown', (event) => {
  if (event.key !== 'Escape' || event.repeat) return;
  event.preventDefault();
  stop();
});

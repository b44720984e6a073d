// Do: one press starts one task, of the component that the person has chosen and of no other.

import { at, card, CHANGED, element, Presses, setLong, setText, short, showAll, span } from './elements.js';
import { goalText, makeField, meaning, valueOf } from './fields.js';
import { Ready } from './ready.js';
import { LATE } from './rosbridge.js';

const KEPT_GOALS = 20;
const OTHER = '*';
// What a server says of a task without progress or result.
export const NOTHING = 'None';
// Longest wait for the answer to a goal until the next press counts.
const ANSWER = 1000;

export class Form {
  #bridge;
  #console;
  // The component for which the form stands, also while no robot has it: { robot, action, handler, component }; the
  // last two are missing for the choice of any other of its scope.
  #chosen = null;
  #robots = [];
  #goals = [];
  #pressed = -Infinity;
  #presses = new Presses();
  #answered = true;
  // What the component says of itself: for which choice and name it was asked, the robot's number of it, what it said, whether
  // that is known for this choice, whether an answer is awaited, and since when it is something else than before.
  #described = { chosen: null, action: null, number: null, is: null, isKnown: false, waits: false, changed: -Infinity };
  // The field for its goals; without one, a goal is free text.
  #field = null;
  // A text that the field is to show when it is there.
  #wanted = null;
  #ready;

  // The console tells its clock (now) and why nothing may be started (whyNot), and hears of a start (started).
  constructor(bridge, console) {
    this.#bridge = bridge;
    this.#console = console;
    this.#ready = new Ready((goal) => this.#fill(goal), () => this.show());
    at('component').addEventListener('change', () => {
      const value = at('component').value;
      this.#chosen = value ? JSON.parse(value) : null;
      this.#wanted = null;
      setText(at('form-said'), '');
      this.show();
    });
    at('other').addEventListener('input', () => this.show());
    at('form').addEventListener('submit', (event) => { event.preventDefault(); this.#press(); });
    at('form').addEventListener('keydown', (event) => {
      if (event.key === 'Enter' && event.repeat) event.preventDefault();
    });
    at('goal').addEventListener('input', () => { this.#wanted = null; this.show(); });
    at('as-text').addEventListener('change', () => {
      if (at('as-text').checked) at('goal').value = goalText(this.#field.read()) ?? '';
      else this.#setGoal(at('goal').value);
      this.show();
    });
    at('start').addEventListener('click', (event) => {
      // Keys press without a place.
      this.#presses.isKey = event.detail === 0;
      // A double click, by the browser's own measure.
      if (event.detail < 2) return;
      event.preventDefault();
      this.#ignore();
    });
  }

  // Shows what the robots offer now.
  offer(robots) {
    this.#robots = robots;
    this.show();
  }

  show() {
    this.#showChoices();
    this.#describe();
    this.#showGoal();
    const why = this.#whyNot();
    at('start').setAttribute('aria-disabled', String(why !== '' || this.#isLocked()));
    // Two robots may have components of the same names.
    setText(at('start'), this.#chosen ? `Start on ${this.#chosen.robot}` : 'Start');
    const said = at('form-said').textContent;
    setText(at('why-not'), said === `NOT SENT: ${why}` ? '' : why);
    this.#showGoals();
    this.#ready.show(this.#robots.map((robot) => robot.name));
  }

  // Learns what the chosen component takes, and again when that changes.
  #describe() {
    const of = this.#described;
    const [chosen, action] = [this.#chosen, this.#action()];
    const isOther = !same(of.chosen, chosen);
    const isNew = isOther || of.action !== action;
    const number = this.#robots.find((robot) => robot.name === chosen?.robot)?.described ?? null;
    // A robot that has not told anything yet, since the console was started again, takes what it took.
    if (!isNew && (number === null || number === of.number)) return;
    Object.assign(of, { chosen, action, number, waits: false });
    if (isNew) {
      of.isKnown = action === null;
      // What was written as text stays while a name is written.
      this.#take(null, isOther || of.is !== null);
    }
    if (number === 0) this.#know(null);
    if (!number || action === null) return;
    of.waits = true;
    const isOld = () => of.number !== number || of.action !== action || !same(of.chosen, chosen);
    this.#bridge.call('/ztl/describe', { action }).then(({ is }) => {
      if (isOld()) return;
      of.waits = false;
      this.#know(is);
      this.show();
    }, () => {
      if (isOld()) return;
      of.waits = false;
      // It is asked again over the next connection. What cannot be learnt is for the console to check.
      if (!this.#bridge.isOpen) of.number = null;
      else of.isKnown = true;
      this.show();
    });
  }

  // The component has said what it takes. If that is something else than before, a press is not for it.
  #know(is) {
    const of = this.#described;
    const [before, now] = [ruleOf(of.is), ruleOf(is)];
    const isOther = of.isKnown && !same(before, now);
    of.isKnown = true;
    // A value of before is not to be sent with another unit.
    const isCleared = isOther && !same(meaning(before), meaning(now));
    if (isCleared) this.#wanted = null;
    this.#take(is, isCleared);
    if (!isOther) return;
    of.changed = performance.now();
    setText(at('form-said'), `What ${this.#name().replace('/', ' ')} takes has changed${isCleared ? ': enter the goal again' : ''}.`);
    this.#showSoon();
  }

  // The component takes what it says. What was filled in stays, unless it is for another component.
  #take(is, isNew) {
    if (!isNew && same(this.#described.is, is)) return;
    const wasField = this.#field !== null && !at('as-text').checked;
    const text = this.#wanted ?? (isNew ? '' : this.#text() ?? '');
    this.#described.is = is;
    const rule = ruleOf(is);
    this.#field = rule.type === 'any' ? null : makeField(rule, 'Goal', () => { this.#wanted = null; this.show(); });
    at('fields').replaceChildren(...(this.#field ? [this.#field.element] : []));
    at('as-text').checked = false;
    const examples = is?.examples?.length ? `for example ${is.examples.map(short).join(' or ')}` : '';
    const usually = is?.usually_ms ? `usually takes ${span(is.usually_ms)}` : '';
    const abort = is?.abort === false ? 'CANNOT BE ABORTED' : '';
    setText(at('about'), [is?.about, examples, usually, abort].filter(Boolean).join(' · '));
    this.#setGoal(text);
    // What does not fit any longer stays in its field, which says so.
    if (wasField && this.#wanted === null) at('as-text').checked = false;
  }

  // Shows a goal in the field, or as text if the field cannot show exactly this.
  #setGoal(text) {
    at('goal').value = text;
    if (!this.#field) return;
    // Nothing is not yet an empty text, unless a goal that was sent was one.
    const isNothing = text === '' && this.#wanted === null;
    const value = isNothing ? undefined : valueOf(this.#described.is.goal, text);
    const shows = this.#field.fill(value) && goalText(this.#field.read()) === text;
    at('as-text').checked = text !== '' && !shows;
  }

  // The goal that the form shows; undefined if it is not complete.
  #text() {
    return this.#field && !at('as-text').checked ? goalText(this.#field.read()) : at('goal').value;
  }

  #showGoal() {
    const isField = this.#field !== null && !at('as-text').checked;
    at('as-text-label').hidden = this.#field === null;
    at('fields').hidden = !isField;
    at('goal-box').hidden = isField;
    const text = this.#text();
    at('sends').hidden = !isField;
    setText(at('sends'), text === undefined ? 'sends nothing yet' : text === '' ? 'sends an empty goal' : `sends: ${text}`);
  }

  #isLocked() {
    return this.#presses.follow || this.#hasChanged() || (!this.#answered && performance.now() - this.#pressed < ANSWER);
  }

  #hasChanged() {
    return performance.now() - this.#described.changed < CHANGED;
  }

  // Why a press starts nothing now; empty if it does.
  #whyNot() {
    const why = this.#console.whyNot();
    if (why) return why;
    if (!this.#chosen) return 'Choose a component.';
    const robot = this.#robots.find((one) => one.name === this.#chosen.robot);
    if (!robot) return `No robot is named ${this.#chosen.robot}: it may have another name now. Choose again.`;
    if (robot.health === 'missing') return `${robot.name} is missing.`;
    if (!this.#choices().some((choice) => same(choice, this.#chosen))) {
      return `${label(this.#chosen)} of ${robot.name} is gone. Choose again, or wait until it is back.`;
    }
    if (this.#action() === null) return 'Name a handler and a component.';
    if (!this.#described.isKnown || this.#described.waits) return 'Asking what it takes.';
    if (this.#text() === undefined) return 'The goal is not complete.';
    const action = this.#action();
    const waits = (goal) => !goal.answered && goal.chosen.robot === robot.name && goal.action === action;
    if (this.#goals.some(waits)) return 'The goal before has no answer yet.';
    return '';
  }

  // The chosen handler/component.
  #name() {
    const { handler, component } = this.#chosen;
    return handler === undefined ? at('other').value.trim() : `${handler}/${component}`;
  }

  // The action of the chosen component; nothing while it has no name.
  #action() {
    if (this.#chosen === null || !this.#name().includes('/')) return null;
    return `${this.#chosen.action}/${this.#name()}`;
  }

  // One choice for each component that a robot tells, and one for any other of its scope.
  #choices() {
    return this.#robots.flatMap((robot) => robot.scopes.flatMap((scope) => {
      const base = { robot: robot.name, action: scope.action };
      const named = Object.entries(scope.handlers ?? {})
        .flatMap(([handler, components]) => components.map((component) => ({ ...base, handler, component })))
        .filter((choice) => choice.handler !== OTHER && choice.component !== OTHER);
      return [...named, base];
    }));
  }

  // What was chosen stays chosen, also when it is gone. Nothing else is ever chosen for the person.
  #showChoices() {
    const select = at('component');
    const all = this.#choices();
    const gone = this.#chosen !== null && !all.some((choice) => same(choice, this.#chosen));
    const names = new Set(this.#robots.map((robot) => robot.name));
    if (gone) names.add(this.#chosen.robot);
    const make = (name) => (name === '' ? element('option', '', 'choose …') : element('optgroup'));
    showAll(select, ['', ...names], (name) => name, make, (made, name) => {
      if (name === '') {
        made.value = '';
        return;
      }
      made.label = name;
      const own = all.filter((choice) => choice.robot === name);
      if (gone && this.#chosen.robot === name) own.push(this.#chosen);
      showAll(made, own, JSON.stringify, () => element('option'), (option, choice) => {
        option.value = JSON.stringify(choice);
        setText(option, gone && choice === this.#chosen ? `${label(choice)} (gone)` : label(choice));
      });
    });
    const value = this.#chosen ? JSON.stringify(this.#chosen) : '';
    if (select.value !== value) select.value = value;
    select.classList.toggle('gone', gone);
    at('other-box').hidden = this.#chosen === null || this.#chosen.handler !== undefined;
  }

  #press() {
    if (this.#hasChanged()) {
      setText(at('form-said'), 'NOT SENT: what it takes changed as you pressed. Look, and press again.');
      return;
    }
    if (this.#isLocked()) {
      this.#ignore();
      return;
    }
    const why = this.#whyNot();
    if (why) {
      setText(at('form-said'), `NOT SENT: ${why}`);
      this.show();
      return;
    }
    const [name, text, action] = [this.#name(), this.#text(), this.#action()];
    const goal = { chosen: this.#chosen, action, name, text, state: 'sent', progress: '', ended: false, answered: false };
    const answered = () => {
      goal.answered = true;
      if (goal === this.#goals[0]) this.#answered = true;
      this.show();
    };
    goal.id = this.#bridge.goal(goal.action, { goal: text, not_after_ms: this.#console.now() + LATE }, {
      feedback: (told) => { goal.state = 'running'; goal.progress = told.progress; answered(); },
      result: (told) => { goal.state = told.state; goal.progress = told.text; goal.ended = true; answered(); },
      open: () => { goal.state = 'running'; goal.progress = ''; goal.ended = false; answered(); },
      lost: () => {
        goal.state = 'UNKNOWN';
        goal.progress = 'the connection was lost: it is not sent again, and Now shows whether it runs';
        goal.ended = true;
        answered();
      },
    });
    if (goal.id === undefined) {
      setText(at('form-said'), 'NOT SENT: no connection');
      return;
    }
    this.#pressed = performance.now();
    this.#presses.note();
    this.#answered = false;
    this.#goals = [goal, ...this.#goals].slice(0, KEPT_GOALS);
    this.#ready.used({ chosen: this.#chosen, name, text });
    setText(at('form-said'), '');
    this.#console.started();
    this.show();
    this.#showSoon();
  }

  // As long as presses follow each other, none of them counts.
  #ignore() {
    this.#presses.note();
    setText(at('form-said'), 'Presses that follow at once do not count.');
    this.#showSoon();
  }

  #showSoon() {
    for (const pause of [CHANGED, this.#presses.gap, ANSWER]) setTimeout(() => this.show(), pause + 1);
  }

  #fill(goal) {
    this.#chosen = goal.chosen;
    this.#wanted = goal.text;
    at('other').value = goal.name;
    this.#setGoal(goal.text);
    setText(at('form-said'), '');
    this.show();
    at('form').querySelector('#fields:not([hidden]) input, #goal-box:not([hidden]) input, button')?.focus();
  }

  #showGoals() {
    at('goals-box').hidden = this.#goals.length === 0;
    const cancel = (made) => {
      made.goal.progress = 'abort sent';
      if (!this.#bridge.cancel(made.goal.id, made.goal.action)) made.goal.progress = 'abort NOT SENT: no connection';
      this.#showGoals();
    };
    const make = () => card(['name', '', 'quiet'], [['Abort', cancel], ['Again', (made) => this.#fill(made.goal)]]);
    showAll(at('goals'), this.#goals, (goal) => goal.id, make, (made, goal) => {
      made.goal = goal;
      const [name, said, about] = made.lines;
      setLong(name, `${goal.name} ${goal.text}`);
      said.className = goal.state === 'COMPLETED' ? 'good' : goal.ended ? 'bad' : '';
      setLong(said, [goal.state, goal.progress].filter((text) => text && text !== NOTHING).join(': '));
      setText(about, goal.chosen.robot);
      const [abort, again] = made.buttons;
      abort.hidden = goal.ended;
      again.hidden = !goal.ended;
      abort.setAttribute('aria-label', `Abort ${short(`${goal.name} ${goal.text}`)}`);
      again.setAttribute('aria-label', `Again ${short(`${goal.name} ${goal.text}`)}: fill in the form`);
    });
  }
}

function same(one, other) {
  return JSON.stringify(one) === JSON.stringify(other);
}

// What a component takes, by what it says of itself.
function ruleOf(is) {
  return is?.goal ?? { type: 'any' };
}

function label(choice) {
  return choice.handler === undefined ? `another of ${choice.action} …` : `${choice.handler} ${choice.component}`;
}

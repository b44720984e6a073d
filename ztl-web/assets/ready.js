// Goals to fill in the form with: those that the person keeps, and the last ones. They stay in this browser.

import { at, element, setText, short, showAll } from './elements.js';

const LAST = 6;
const KEPT = 40;
const STORE = 'ready-goals';

export class Ready {
  // Each: { chosen, name, text, kept }.
  #goals = read();
  #fill;
  #changed;

  // `fill` fills in the form with a goal; `changed` shows them again.
  constructor(fill, changed) {
    this.#fill = fill;
    this.#changed = changed;
    // Another page of this browser has changed them.
    addEventListener('storage', () => { this.#goals = read(); this.#changed(); });
  }

  // A goal was started.
  used(goal) {
    const known = this.#goals.find((one) => keyOf(one) === keyOf(goal));
    const others = this.#goals.filter((one) => one !== known);
    this.#set([{ ...goal, kept: known?.kept ?? false }, ...others]);
  }

  // Shows them, and which of them are for a robot that is not one of these.
  show(robots) {
    at('ready-box').hidden = this.#goals.length === 0;
    const ordered = [...this.#goals.filter((goal) => goal.kept), ...this.#goals.filter((goal) => !goal.kept)];
    showAll(at('ready'), ordered, keyOf, () => this.#row(), (row, goal) => {
      row.goal = goal;
      const [fill, keep] = row.children;
      const what = short(`${goal.name} ${goal.text}`);
      setText(fill.firstChild, what);
      const { robot } = goal.chosen;
      setText(fill.lastChild, robots.includes(robot) ? robot : `${robot} (gone)`);
      setText(keep, goal.kept ? '★' : '☆');
      keep.setAttribute('aria-pressed', String(goal.kept));
      keep.setAttribute('aria-label', `Keep ${what} of ${goal.chosen.robot}`);
    });
  }

  #row() {
    const row = element('li', 'ready');
    const fill = element('button', 'fill');
    fill.append(element('span', 'name'), element('span', 'quiet'));
    fill.addEventListener('click', () => this.#fill(row.goal));
    const keep = element('button', 'keep');
    keep.addEventListener('click', () => {
      this.#set(this.#goals.map((goal) => (goal === row.goal ? { ...goal, kept: !goal.kept } : goal)));
      this.#changed();
    });
    for (const button of [fill, keep]) button.type = 'button';
    row.append(fill, keep);
    return row;
  }

  #set(goals) {
    const kept = goals.filter((goal) => goal.kept).slice(0, KEPT);
    const last = goals.filter((goal) => !goal.kept).slice(0, LAST);
    this.#goals = [...last, ...kept];
    try {
      localStorage.setItem(STORE, JSON.stringify(this.#goals));
    } catch {
      // No space: they last as long as the page.
    }
  }
}

function keyOf(goal) {
  return JSON.stringify([goal.chosen, goal.name, goal.text]);
}

// What is not as this page writes it is left out.
function read() {
  try {
    const isText = (value) => typeof value === 'string';
    const isGoal = (goal) => isText(goal.name) && isText(goal.text) && isText(goal.chosen.robot) && isText(goal.chosen.action);
    return JSON.parse(localStorage.getItem(STORE) ?? '[]').filter(isGoal);
  } catch {
    return [];
  }
}

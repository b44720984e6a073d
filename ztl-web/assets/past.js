// Past: the record of the show; and the tasks of the last hours that the console has seen end, while this part is open.

import { at, card, setLong, setText, showAll } from './elements.js';
import { NOTHING } from './form.js';

// Between two questions, however many tasks end and keys are pressed.
const PAUSE = 500;

export class Past {
  #bridge;
  #waits = false;

  constructor(bridge) {
    this.#bridge = bridge;
    at('past-box').addEventListener('toggle', () => this.look());
    at('past-filter').addEventListener('input', () => this.look());
    at('past-form').addEventListener('submit', (event) => event.preventDefault());
  }

  // There is a show, which may be recorded.
  showRecord(isRecorded) {
    at('record').hidden = false;
    at('record-links').hidden = !isRecorded;
    at('record-none').hidden = isRecorded;
  }

  // Asks again, soon.
  look() {
    if (this.#waits || !at('past-box').open) return;
    this.#waits = true;
    setTimeout(() => { this.#waits = false; this.#ask(); }, PAUSE);
  }

  async #ask() {
    const filter = at('past-filter').value;
    const told = await this.#bridge.call('/ztl/past', { filter }).catch(() => null);
    if (told === null) return;
    const key = (task) => JSON.stringify([task.robot, task.scope, task.id]);
    showAll(at('past'), told.tasks, key, () => card(['name', '', 'quiet'], []), (made, task) => {
      const [name, said, about] = made.lines;
      setLong(name, task.task || `task ${task.id}`);
      said.className = task.state === 'COMPLETED' ? 'good' : 'bad';
      setLong(said, [task.state, task.text].filter((text) => text && text !== NOTHING).join(': '));
      const started = new Date(task.started_ms ?? task.seen_ms).toLocaleTimeString();
      setText(about, [started, `${task.robot} ${task.scope}`, task.by ? `by ${task.by}` : ''].filter(Boolean).join(' · '));
    });
    const nothing = filter ? 'No task contains this.' : 'The console has not seen a task end.';
    setText(at('past-more'), told.more ? `and ${told.more} more` : told.tasks.length ? '' : nothing);
  }
}

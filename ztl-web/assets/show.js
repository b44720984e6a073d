// The show: the scenes of a script, its cues, and notes. The console plays; this page shows, and says what was pressed.

import { at, CHANGED, element, Presses, setText, showAll } from './elements.js';
import { LATE } from './rosbridge.js';

const SIGNS = { pending: '·', playing: '▶', completed: '✓', failed: '✗', stopped: '■', skipped: '−' };
// Each with what it says, and what may be pressed for it.
const COMMANDS = {
  skip: 'Skip', pause: 'Pause', replay: 'Replay last', go_on: 'Go on anyway', retry: 'Retry failed', restart: 'Restart',
};
const WRONG = new Set(['failed', 'rejected', 'not started', 'unknown', 'aborted']);

export class Show {
  #bridge;
  #now;
  #whyNot;
  #recorded;
  // What the console tells; nothing without a show.
  #told = null;
  // When the question changed, and which it is.
  #changed = -Infinity;
  #number = null;
  // Of each cue.
  #presses = new Map();

  constructor(bridge, { now, whyNot, recorded }) {
    this.#bridge = bridge;
    this.#recorded = recorded;
    this.#now = now;
    this.#whyNot = whyNot;
    for (const [name, text] of Object.entries(COMMANDS)) {
      const button = element('button', '', text);
      button.type = 'button';
      button.dataset.do = name;
      button.addEventListener('click', () => this.#command(name, button));
      at('show-commands').append(button);
    }
    at('show-play').addEventListener('click', () => this.#command('start', at('show-play')));
    at('show-stop').addEventListener('click', () => this.#call('/ztl/show/stop_scene', {}));
    at('show-note').addEventListener('submit', (event) => {
      event.preventDefault();
      this.#note();
    });
    // A held key is one press.
    at('show').addEventListener('keydown', (event) => {
      if (event.repeat && event.key === 'Enter') event.preventDefault();
    });
    addEventListener('keydown', (event) => this.#key(event));
    bridge.subscribe('/ztl/show', (told) => {
      if ((told.question?.number ?? null) !== this.#number || told.scene !== this.#told?.scene) this.#changed = performance.now();
      this.#number = told.question?.number ?? null;
      this.#told = told;
      this.#recorded(told.recorded);
      this.show();
    });
  }

  // Why nothing can be pressed; empty if it can.
  #off() {
    return this.#told?.ended ? 'The show has ended.' : this.#whyNot();
  }

  show() {
    const told = this.#told;
    at('show').hidden = told === null;
    if (told === null) return;
    setText(at('show-script'), told.script + (told.recorded ? ' · recorded' : ' · not recorded'));
    this.#showState(told);
    const scene = told.scene === null ? null : told.scenes[told.scene];
    const can = (name) => told.choices.includes(name) && this.#off() === '';
    enable(at('show-play'), can('start'));
    // Also while it plays: nothing below moves as it is pressed.
    setText(at('show-play'), scene && told.question?.about !== 'end' ? `Play: ${scene.name}` : 'Play');
    enable(at('show-stop'), told.choices.includes('stop_scene') && this.#bridge.isOpen);
    for (const button of at('show-commands').children) {
      const name = button.dataset.do;
      if (name === 'pause') {
        const resumes = told.choices.includes('resume');
        if (button.resumes !== resumes) [button.resumes, button.changed] = [resumes, performance.now()];
        setText(button, resumes ? 'Go on after pause' : 'Pause after step');
        enable(button, can('pause') || can('resume'));
      } else {
        enable(button, can(name));
      }
    }
    this.#showScenes(told, can('jump'));
    this.#showSteps(told);
    this.#showCues(told);
    const notes = told.notes.toReversed();
    showAll(at('show-notes'), notes, (note) => `${note.at_ms} ${note.text}`, () => element('li'), (made, note) => {
      setText(made, `${new Date(note.at_ms).toLocaleTimeString()} ${note.text}`);
    });
    enable(at('show-note-add'), this.#off() === '');
  }

  #showState(told) {
    const scene = told.scene === null ? '' : told.scenes[told.scene].name;
    const about = told.question?.about;
    let said = told.plays ? `Plays: ${scene}` : '';
    let urgent = false;
    if (told.ended) said = 'The show has ended.';
    else if (told.stopping && !told.stopping.over) said = `Stopping: ${scene}`;
    else if (about === 'scene') said = `Next: ${scene}`;
    else if (about === 'end') said = 'The last scene is over.';
    else if (about === 'pause') said = `PAUSE: ${scene}`;
    else if (about === 'step') [said, urgent] = [`DECIDE: ${told.waiting ?? 'a step waits'}`, true];
    else if (told.choices.includes('resume')) said += '; a pause follows this step';
    setText(at('show-state'), said);
    at('show-state').className = urgent ? 'bad' : 'name';
    const after = told.gone === null || told.gone === undefined ? '' : `This scene is stopped if nobody operates for ${told.gone} s.`;
    setText(at('show-gone'), after);
    const lacking = told.servers.filter((server) => server.state !== 'answers' && server.state !== 'unknown');
    showAll(at('show-missing'), lacking, (server) => server.name, () => element('li', 'bad'), (made, server) => {
      setText(made, `${server.name}: ${server.state.toUpperCase()} ${server.text}`);
    });
    const stopped = told.stopping?.tasks ?? [];
    showAll(at('show-stopped'), stopped, (task) => task.number.toString(), () => element('li'), (made, task) => {
      made.className = task.confirmed ? 'good' : task.confirmed === null ? 'quiet' : 'bad';
      const word = task.confirmed ? 'stopped' : task.confirmed === null ? 'stopping' : 'NOT CONFIRMED';
      setText(made, `${word}: ${task.task} ${task.text ?? ''}`);
    });
  }

  #showScenes(told, can) {
    const scenes = told.scenes.map((scene, index) => ({ ...scene, index }));
    showAll(at('show-scenes'), scenes, (scene) => String(scene.index), (scene) => this.#sceneButton(scene.index), (made, scene) => {
      const button = made.firstChild;
      setText(button, `${SIGNS[scene.state]} ${scene.index + 1} ${scene.name}`);
      button.setAttribute('aria-label', `Show scene ${scene.index + 1}, ${scene.name}, ${scene.state}`);
      if (scene.index === told.scene) button.setAttribute('aria-current', 'true');
      else button.removeAttribute('aria-current');
      enable(button, can);
    });
  }

  #sceneButton(scene) {
    const made = element('li');
    const button = element('button');
    button.type = 'button';
    button.addEventListener('click', () => this.#press(button, '/ztl/show/command', { do: 'jump', scene, question: this.#number }));
    made.append(button);
    return made;
  }

  #showSteps(told) {
    const steps = told.steps.map((step, index) => ({ ...step, index }));
    const background = told.background.length ? [{ name: 'in the background', state: 'playing', tasks: told.background, index: 'b' }] : [];
    showAll(at('show-steps'), [...steps, ...background], (step) => `${told.scene} ${step.index}`, stepItem, (made, step) => {
      setText(made.firstChild, `${SIGNS[step.state]} ${step.name}`);
      made.firstChild.className = step.state === 'failed' ? 'bad' : 'name';
      made.dataset.state = step.state;
      const tasks = step.tasks.map((task, index) => ({ ...task, index }));
      showAll(made.lastChild, tasks, (task) => String(task.index), () => element('li'), (line, task) => {
        line.className = WRONG.has(task.state) ? 'bad' : task.state === 'planned' ? 'quiet' : '';
        setText(line, `${task.task} ${task.state} ${task.text}`);
      });
    });
  }

  #showCues(told) {
    at('show-cues-box').hidden = told.cues.length === 0;
    const cues = told.cues.map((cue, index) => ({ ...cue, index }));
    showAll(at('show-cues'), cues, (cue) => String(cue.index), (cue) => this.#cueItem(cue.index), (made, cue) => {
      const [button, said] = made.children;
      const runs = cue.tasks.some((task) => ['asked', 'initiated', 'accepted'].includes(task.state));
      const [name, key] = button.children;
      setText(name, cue.name);
      setText(key, cue.key ?? '');
      key.hidden = cue.key === null;
      if (cue.key !== null) button.setAttribute('aria-keyshortcuts', cue.key);
      enable(button, this.#off() === '' && !runs);
      const after = cue.gone === null ? '' : `, aborted if nobody operates for ${cue.gone} s`;
      const states = cue.tasks.map((task) => `${task.task} ${task.state} ${task.text}`);
      said.className = cue.tasks.some((task) => WRONG.has(task.state)) ? 'bad' : 'quiet';
      setText(said, states.length ? states.join('\n') : cue.does.join('\n') + after);
    });
  }

  #cueItem(cue) {
    const made = element('li');
    const button = element('button');
    button.type = 'button';
    button.append(element('span'), element('kbd'));
    button.addEventListener('click', (event) => this.#cue(cue, event.detail === 0));
    made.append(button, element('p', 'quiet'));
    return made;
  }

  #key(event) {
    const free = !(event.target instanceof Element) || event.target.closest('input, select, textarea') === null;
    if (event.repeat || event.ctrlKey || event.metaKey || event.altKey || !free) return;
    const cue = this.#told?.cues.findIndex((one) => one.key === event.key.toLowerCase()) ?? -1;
    if (cue < 0) return;
    event.preventDefault();
    this.#cue(cue, true);
  }

  #cue(cue, isKey) {
    const presses = this.#presses.get(cue) ?? new Presses();
    this.#presses.set(cue, presses);
    const follows = presses.follow;
    presses.isKey = isKey;
    presses.note();
    if (follows) {
      this.#say('Presses that follow at once do not count.');
      return;
    }
    const off = this.#off();
    if (off !== '') this.#say(`NOT SENT: ${off}`);
    else this.#call('/ztl/show/cue', { cue });
  }

  #command(name, button) {
    const word = name === 'pause' && this.#told?.choices.includes('resume') ? 'resume' : name;
    this.#press(button, '/ztl/show/command', { do: word, question: this.#number });
  }

  #press(button, service, args) {
    if (button.getAttribute('aria-disabled') === 'true') return;
    if (performance.now() - Math.max(this.#changed, button.changed ?? -Infinity) < CHANGED) {
      this.#say('NOT SENT: the show changed as you pressed. Look, and press again.');
      return;
    }
    this.#call(service, args);
  }

  async #note() {
    const text = at('show-note-text').value;
    if (this.#off() === '' && text.trim() !== '' && await this.#call('/ztl/show/note', { text })) at('show-note-text').value = '';
  }

  async #call(service, args) {
    try {
      await this.#bridge.call(service, { ...args, not_after_ms: this.#now() + LATE });
      this.#say('');
      return true;
    } catch (error) {
      this.#say(error.message);
      return false;
    }
  }

  #say(text) {
    setText(at('show-said'), text);
  }
}

function enable(button, on) {
  button.setAttribute('aria-disabled', String(!on));
}

function stepItem() {
  const made = element('li');
  made.append(element('p', 'name'), element('ul', 'plain'));
  return made;
}

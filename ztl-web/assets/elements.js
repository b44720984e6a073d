// Elements whose text is always text: nothing of a robot or a client is ever read as HTML.

// How many characters of a text are shown. A result may have any length.
const SHOWN = 240;
// Controls, except for lines and tabs, and what turns the direction of a text or has no width.
const UNSEEN = /(?![\n\t])[\p{Cc}\p{Bidi_Control}\p{Zl}\p{Zp}\u200b\u2060\ufeff]/gu;

// A press on a button that has changed since was meant for what it said before.
export const CHANGED = 600;
// A press that follows sooner belongs to the one before: a double click, or a key that is held on a remote desktop.
const SAME_PRESS = 600;
// The same for keys: so long do systems wait until they repeat a held one.
const SAME_KEY = 1100;

// As long as presses follow each other, none of them counts but the first.
export class Presses {
  #until = -Infinity;
  #gap = SAME_PRESS;

  // How soon after the last press another one counts.
  get gap() {
    return this.#gap;
  }

  set isKey(isKey) {
    this.#gap = isKey ? SAME_KEY : SAME_PRESS;
  }

  // Whether a press now belongs to the one before.
  get follow() {
    return performance.now() < this.#until;
  }

  // There was a press.
  note() {
    this.#until = performance.now() + this.#gap;
  }
}

export const at = (id) => document.getElementById(id);

export function element(tag, names, text) {
  const made = document.createElement(tag);
  if (names) made.className = names;
  if (text !== undefined) made.textContent = plain(text);
  return made;
}

export function setText(where, text) {
  const shown = plain(text);
  if (where.textContent !== shown) where.textContent = shown;
}

// A text without what nobody sees but which changes how the rest reads: it is written as \uXXXX.
export function plain(text) {
  return String(text).replace(UNSEEN, (one) => `\\u${one.charCodeAt(0).toString(16).padStart(4, '0')}`);
}

// The beginning of a text.
export function short(text) {
  return text.length <= SHOWN ? text : `${text.slice(0, SHOWN)} …`;
}

// Shows the beginning of a text, and a button under it that shows all.
export function setLong(where, text) {
  let more = where.nextElementSibling;
  if (!more?.classList.contains('more')) {
    more = element('button', 'more');
    more.type = 'button';
    more.addEventListener('click', () => {
      const shows = more.getAttribute('aria-expanded') === 'true';
      more.setAttribute('aria-expanded', String(!shows));
      setLong(where, where.whole);
    });
    more.setAttribute('aria-expanded', 'false');
    where.after(more);
  }
  where.whole = text;
  more.hidden = short(text) === text;
  const showsAll = more.getAttribute('aria-expanded') === 'true';
  setText(more, showsAll ? 'Show less' : `Show all ${text.length} characters`);
  setText(where, showsAll ? text : short(text));
}

// Shows items as children of a list. Keeps the element of each key, so that focus and clicks survive an update.
export function showAll(list, items, keyOf, make, update) {
  const known = new Map([...list.children].map((child) => [child.dataset.key, child]));
  let before = null;
  for (const item of items) {
    const key = keyOf(item);
    const child = known.get(key) ?? make(item);
    known.delete(key);
    child.dataset.key = key;
    update(child, item);
    const place = before ? before.nextSibling : list.firstChild;
    if (child !== place) list.insertBefore(child, place);
    before = child;
  }
  for (const child of known.values()) child.remove();
}

// A card with lines of text, and buttons beside them.
export function card(lines, buttons) {
  const made = element('li', 'card');
  const row = element('div', 'row');
  const texts = element('div');
  for (const names of lines) texts.append(element('p', names));
  const side = element('div');
  for (const [name, act] of buttons) {
    const button = element('button', 'act', name);
    button.type = 'button';
    button.addEventListener('click', () => act(made, button));
    side.append(button);
  }
  row.append(texts, side);
  made.append(row);
  made.lines = [...texts.children];
  made.buttons = [...side.children];
  return made;
}

export function span(ms) {
  const seconds = Math.max(0, Math.round(ms / 1000));
  if (seconds < 100) return `${seconds} s`;
  const minutes = Math.round(seconds / 60);
  return minutes < 100 ? `${minutes} min` : `${Math.round(minutes / 60)} h`;
}

// Elements whose text is always text: nothing of a robot or a client is ever read as HTML.

// How many characters of a text are shown. A result may have any length.
const SHOWN = 240;

export const at = (id) => document.getElementById(id);

export function element(tag, names, text) {
  const made = document.createElement(tag);
  if (names) made.className = names;
  if (text !== undefined) made.textContent = text;
  return made;
}

export function setText(where, text) {
  if (where.textContent !== text) where.textContent = text;
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

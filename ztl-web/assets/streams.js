// Streams: the newest values of publishers, while their part is open. Numbers as lines, pictures as pictures.

import { at, element, setText, showAll, span } from './elements.js';

// How long a line reaches back.
const MINUTE = 60_000;
// As in the template of the page.
const [WIDTH, HEIGHT] = [300, 60];

export class Streams {
  #bridge;
  #now;
  #told = new Map();

  constructor(bridge, now) {
    this.#bridge = bridge;
    this.#now = now;
  }

  // Shows these publishers, each closed until a person opens it.
  offer(names) {
    at('streams').hidden = names.length === 0;
    showAll(at('publishers'), names, (name) => name, (name) => this.#publisher(name), () => {});
  }

  // Time passes.
  show() {
    for (const [made, told] of this.#told) this.#update(made, told);
  }

  #publisher(name) {
    const made = element('li', 'card');
    const box = element('details');
    const list = element('ul', 'streams');
    box.append(element('summary', 'name', name), element('p', 'bad'), list);
    made.append(box);
    const topic = `/ztl/streams/${name}`;
    box.addEventListener('toggle', () => {
      if (box.open) {
        this.#bridge.subscribe(topic, (told) => { this.#told.set(box, told); this.#update(box, told); });
      } else {
        this.#bridge.unsubscribe(topic);
        this.#told.delete(box);
        list.replaceChildren();
      }
    });
    return made;
  }

  #update(box, told) {
    const [, said, list] = box.children;
    setText(said, told.text ?? (told.streams.length === 0 ? 'nothing was published yet' : ''));
    showAll(list, told.streams ?? [], (stream) => String(stream.number), () => row(), (made, stream) => {
      const [topic, text, lines, picture] = made.children;
      setText(topic, `${stream.topic} · ${span(this.#now() - stream.at_ms)} ago`);
      setText(text, stream.text);
      text.hidden = stream.picture;
      made.remember(stream);
      const drawn = made.samples.length > 1 && stream.numbers.length > 0;
      // An SVG has no property for it.
      lines.toggleAttribute('hidden', !drawn);
      if (drawn) draw(lines, made.samples, stream);
      picture.hidden = !stream.picture;
      // One after the other: a slow connection shows fewer pictures.
      if (stream.picture && picture.complete && made.count !== stream.count) {
        made.count = stream.count;
        picture.alt = `Picture of ${stream.topic}`;
        picture.src = `/picture/${stream.number}?${stream.count}`;
      }
    });
  }
}

function row() {
  const made = at('stream').content.firstElementChild.cloneNode(true);
  made.samples = [];
  made.remember = (stream) => {
    const last = made.samples.at(-1);
    if (last?.at === stream.at_ms) return;
    made.samples.push({ at: stream.at_ms, numbers: stream.numbers });
    made.samples = made.samples.filter((sample) => stream.at_ms - sample.at <= MINUTE);
  };
  return made;
}

// A line for each number, over the last minute, all on one scale.
function draw(lines, samples, stream) {
  const values = samples.flatMap((sample) => sample.numbers.map(([, value]) => value));
  const [least, most] = [Math.min(...values), Math.max(...values)];
  const y = (value) => (most === least ? HEIGHT / 2 : HEIGHT - 2 - ((value - least) / (most - least)) * (HEIGHT - 4));
  const x = (time) => WIDTH - ((stream.at_ms - time) / MINUTE) * WIDTH;
  lines.setAttribute('aria-label', `${stream.topic} in the last minute: from ${least} to ${most}`);
  [...lines.children].forEach((line, index) => {
    const name = stream.numbers[index]?.[0];
    const own = samples.map((sample) => [sample.at, sample.numbers.find(([other]) => other === name)?.[1]]);
    const points = own.filter(([, value]) => value !== undefined).map(([time, value]) => `${x(time).toFixed(1)},${y(value).toFixed(1)}`);
    line.setAttribute('points', points.join(' '));
  });
}

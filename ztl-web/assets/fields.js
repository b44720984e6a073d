// Fields for a goal, made from what a component says of it (docs/protocol.md, 11.7).
//
// Each field has its element; `read()`, the value that it shows, or undefined without a valid one; and `fill(value)`,
// which returns whether it can show that value.

import { element, setText } from './elements.js';

// Most items of a list.
const ITEMS = 100;
// How many steps a slider has, if the component names none.
const STEPS = 100;

let count = 0;

// What a value of this rule says, whatever its bounds are: as the value of another one, it says something else.
export function meaning(rule) {
  if (rule['one-of']) return 'a word';
  if (rule['list-of']) return [meaning(rule['list-of'])];
  if (rule.fields) return rule.fields.map((of) => [of.name, meaning(of)]);
  return { type: rule.type, unit: rule.unit };
}

// What a goal must be, in words.
export function words(rule) {
  if (rule['one-of']) return rule['one-of'].join(', ');
  if (rule['list-of']) return `a list, each ${words(rule['list-of'])}`;
  if (rule.fields) return 'fields';
  const { least, most, unit } = rule;
  const kind = { number: 'a number', whole: 'a whole number', truth: 'True or False', nothing: 'nothing', text: 'a text' }[rule.type];
  if (rule.type === 'text' && rule.longest !== undefined) return `a text of at most ${rule.longest} characters`;
  const bounds = least !== undefined && most !== undefined ? `from ${least} to ${most}`
    : least !== undefined ? `of at least ${least}` : most !== undefined ? `of at most ${most}` : unit ? 'in' : '';
  return [kind ?? 'anything', bounds, unit].filter(Boolean).join(' ');
}

// A value as the goal of a component: the text that is sent.
export function goalText(value) {
  if (value === undefined) return undefined;
  if (value === null) return '';
  if (typeof value === 'boolean') return value ? 'True' : 'False';
  return typeof value === 'string' ? value : inner(value);
}

// A value within a goal, in JSON, which is also YAML.
function inner(value) {
  // YAML knows an exponent only after a decimal point.
  if (typeof value === 'number') return String(value).replace(/^(-?\d+)e/, '$1.0e');
  if (Array.isArray(value)) return `[${value.map(inner).join(', ')}]`;
  if (value === null || typeof value !== 'object') return JSON.stringify(value);
  return `{${Object.entries(value).map(([name, of]) => `${JSON.stringify(name)}: ${inner(of)}`).join(', ')}}`;
}

// The value of a goal's text, for a field of this rule; undefined if that cannot be told.
export function valueOf(rule, text) {
  if (rule.type === 'nothing') return text === '' ? null : undefined;
  if (rule.type === 'truth') return { True: true, False: false }[text];
  if (rule.type === 'text' || rule['one-of']) return text;
  try {
    return JSON.parse(text);
  } catch {
    return undefined;
  }
}

// A field for a goal of this rule. `changed` hears of each change.
export function makeField(rule, name, changed) {
  if (rule['one-of']) return choice(rule['one-of'].map((word) => [word, word]), name, changed);
  if (rule['list-of']) return list(rule['list-of'], name, changed);
  if (rule.fields) return struct(rule.fields, name, changed);
  switch (rule.type) {
    case 'truth': return choice([['True', true], ['False', false]], name, changed);
    case 'nothing': return nothing(name);
    case 'number': case 'whole': return number(rule, name, changed);
    default: return text(rule, name, changed);
  }
}

// A label, an input, and under it what the value must be, or why it is not right.
function labelled(rule, name) {
  const box = element('div', 'field');
  const [input, label] = [element('input'), element('label', '', name)];
  const said = element('p', 'quiet', words(rule));
  input.id = `field${++count}`;
  said.id = `${input.id}-said`;
  label.htmlFor = input.id;
  input.setAttribute('aria-describedby', said.id);
  input.spellcheck = false;
  input.autocapitalize = 'off';
  const judge = (isWrong) => {
    input.setAttribute('aria-invalid', String(isWrong));
    said.className = isWrong ? 'bad' : 'quiet';
    setText(said, isWrong ? `This is not ${words(rule)}.` : words(rule));
  };
  box.append(label, input, said);
  return { box, input, label, judge };
}

function number(rule, name, changed) {
  const { least, most, step, unit } = rule;
  const whole = rule.type === 'whole';
  const { box, input, judge } = labelled(rule, unit ? `${name} (${unit})` : name);
  // Not of the type number: the wheel would change it, and what is wrong in it could not be read.
  input.inputMode = least >= 0 ? 'decimal' : 'text';
  let slider = null;
  if (least < most) {
    slider = element('input', 'slider');
    slider.type = 'range';
    slider.min = least;
    slider.max = most;
    slider.step = step > 0 ? step : whole ? 1 : (most - least) / STEPS;
    slider.value = least;
    slider.setAttribute('aria-label', `${name}: slider`);
    slider.classList.add('unset');
    const slid = () => {
      const value = Number(slider.value);
      input.value = String(whole ? value : Number(value.toPrecision(9)));
      changed();
    };
    // A click on where it stands already chooses that value, too.
    for (const event of ['input', 'click']) slider.addEventListener(event, slid);
    // So does a key that would go lower.
    slider.addEventListener('keydown', ({ key }) => {
      if (['Home', 'PageDown', 'ArrowLeft', 'ArrowDown'].includes(key) && slider.classList.contains('unset')) slid();
    });
    input.before(slider);
  }
  const read = () => {
    const written = input.value.trim();
    const value = Number(written);
    const fits = written !== '' && Number.isFinite(value) && /^[-+.\de]+$/i.test(written) && !(value < least) && !(value > most)
      && (!whole || Number.isSafeInteger(value));
    judge(written !== '' && !fits);
    if (slider) {
      slider.classList.toggle('unset', !fits);
      if (fits && Number(slider.value) !== value) slider.value = value;
      slider.setAttribute('aria-valuetext', fits ? `${value} ${unit ?? ''}`.trim() : 'not chosen');
    }
    return fits ? value : undefined;
  };
  input.addEventListener('input', changed);
  return { element: box, read, fill: (value) => { input.value = typeof value === 'number' ? String(value) : ''; return read() !== undefined; } };
}

// A box to tick: what is empty is sent only if the person says so.
function emptiness(kind, name, changed) {
  const label = element('label', 'given');
  const box = element('input');
  box.type = 'checkbox';
  box.setAttribute('aria-label', `Send an empty ${kind}: ${name}`);
  box.addEventListener('change', changed);
  label.append(box, element('span', '', `Send an empty ${kind}`));
  // Whether what is empty may be sent; without anything that is empty, there is no such question.
  const allows = (isEmpty) => {
    label.hidden = !isEmpty;
    if (!isEmpty) box.checked = false;
    return !isEmpty || box.checked;
  };
  return { label, box, allows };
}

function text(rule, name, changed) {
  const { box, input, judge } = labelled(rule, name);
  const empty = emptiness('text', name, changed);
  box.append(empty.label);
  const isAny = rule.type !== 'text';
  const read = () => {
    const isWrong = [...input.value].length > (rule.longest ?? Infinity);
    judge(isWrong);
    if (!empty.allows(input.value === '') || isWrong) return undefined;
    // Within a goal, anything may also be a number, a list, or the like.
    const value = isAny ? valueOf(rule, input.value) : undefined;
    return value === undefined ? input.value : value;
  };
  input.addEventListener('input', changed);
  const fill = (value) => {
    input.value = typeof value === 'string' ? value : inner(value) ?? '';
    empty.box.checked = value === '';
    return read() !== undefined;
  };
  return { element: box, read, fill };
}

function group(name) {
  const box = element('fieldset');
  box.append(element('legend', '', name));
  return box;
}

function nothing(name) {
  const box = group(name);
  box.append(element('p', 'quiet', 'It takes no goal.'));
  return { element: box, read: () => null, fill: (value) => value === null };
}

// Words as buttons, of which one is chosen.
function choice(choices, name, changed) {
  const box = group(name);
  const row = element('div', 'words');
  const of = `field${++count}`;
  const made = choices.map(([word, value]) => {
    const [label, radio] = [element('label', 'word'), element('input')];
    radio.type = 'radio';
    radio.name = of;
    radio.addEventListener('change', changed);
    label.append(radio, element('span', '', word));
    row.append(label);
    return [radio, value];
  });
  box.append(row);
  return {
    element: box,
    read: () => made.find(([radio]) => radio.checked)?.[1],
    fill: (value) => {
      for (const [radio, of] of made) radio.checked = of === value;
      return made.some(([radio]) => radio.checked);
    },
  };
}

function button(name, label, act) {
  const made = element('button', 'act', name);
  made.type = 'button';
  made.setAttribute('aria-label', label);
  made.addEventListener('click', act);
  return made;
}

function list(rule, name, changed) {
  const box = group(name);
  const items = element('ol', 'items');
  const made = [];
  // The numbers in their names follow their places.
  const rename = () => made.forEach(({ row, remove }, place) => {
    row.setAttribute('aria-label', `${name} ${place + 1}`);
    remove.setAttribute('aria-label', `Remove ${name} ${place + 1}`);
  });
  const grow = () => {
    if (made.length >= ITEMS) return null;
    const field = makeField(rule, name, changed);
    const row = element('li');
    const remove = button('Remove', '', () => {
      made.splice(made.findIndex((item) => item.row === row), 1);
      row.remove();
      rename();
      add.focus();
      changed();
    });
    row.append(field.element, remove);
    items.append(row);
    made.push({ row, remove, field });
    rename();
    return field;
  };
  const add = button('Add', `Add to ${name}`, () => {
    grow()?.element.querySelector('input')?.focus();
    changed();
  });
  const empty = emptiness('list', name, changed);
  box.append(items, add, empty.label);
  return {
    element: box,
    read: () => {
      if (!empty.allows(made.length === 0)) return undefined;
      const values = made.map(({ field }) => field.read());
      return values.includes(undefined) ? undefined : values;
    },
    fill: (value) => {
      made.length = 0;
      items.replaceChildren();
      empty.box.checked = Array.isArray(value);
      return Array.isArray(value) && value.every((item) => grow()?.fill(item));
    },
  };
}

function struct(rules, name, changed) {
  const box = group(name);
  const made = rules.map((rule) => {
    const field = makeField(rule, rule.name, changed);
    let given = null;
    if (rule.optional || rule.default !== undefined) {
      const label = element('label', 'given');
      given = element('input');
      given.type = 'checkbox';
      const without = rule.default === undefined ? 'left out' : `otherwise ${rule.default}`;
      label.append(given, element('span', '', `Give ${rule.name} (${without})`));
      given.addEventListener('change', () => { field.element.hidden = !given.checked; changed(); });
      field.element.hidden = true;
      box.append(label);
    }
    box.append(field.element);
    return [rule.name, field, given];
  });
  return {
    element: box,
    read: () => {
      const all = made.filter(([, , given]) => given === null || given.checked).map(([of, field]) => [of, field.read()]);
      return all.some(([, value]) => value === undefined) ? undefined : Object.fromEntries(all);
    },
    fill: (value) => {
      if (value === null || typeof value !== 'object' || Array.isArray(value)) return false;
      if (Object.keys(value).some((of) => !made.some(([known]) => known === of))) return false;
      return made.every(([of, field, given]) => {
        const isGiven = Object.hasOwn(value, of);
        if (given === null) return isGiven && field.fill(value[of]);
        given.checked = isGiven;
        field.element.hidden = !isGiven;
        return !isGiven || field.fill(value[of]);
      });
    },
  };
}

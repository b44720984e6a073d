// Robots: each server with its health, and the devices of a gateway with their links.

import { at, card, element, setText, showAll, span } from './elements.js';

const HEALTH = { there: 'there', missing: 'MISSING', unknown: 'not asked yet' };
const DEVICE = { up: 'up', silent: 'SILENT', absent: 'NOT THERE' };

// Shows robots; now is the console's clock.
export function showRobots(robots, now) {
  showAll(at('robot-list'), robots, (robot) => robot.name, () => robotCard(), (made, robot) => {
    const [name, health, text] = made.lines;
    const isThere = robot.health === 'there';
    setText(name, robot.name);
    health.className = { there: 'good', missing: 'bad' }[robot.health] ?? 'quiet';
    const since = robot.health === 'unknown' ? '' : ` for ${span(now - robot.since_ms)}`;
    setText(health, HEALTH[robot.health] + since);
    setText(text, [robot.endpoint, robot.text].filter(Boolean).join('\n'));
    made.devices.setAttribute('aria-label', `Devices of ${robot.name}`);
    made.devices.hidden = robot.devices.length === 0;
    const key = (device) => JSON.stringify([device.scope, device.name]);
    showAll(made.devices, robot.devices, key, () => deviceRow(), (row, device) => showDevice(row, device, isThere, now));
    setText(made.more, robot.devices_text);
  });
}

function robotCard() {
  const made = card(['name', '', 'quiet'], []);
  made.devices = element('ul', 'devices');
  made.more = element('p', 'bad');
  made.append(made.devices, made.more);
  return made;
}

function deviceRow() {
  const row = element('li');
  row.append(element('p', 'name'), element('p'), element('p', 'quiet'), element('p', 'quiet'));
  return row;
}

function showDevice(row, device, isThere, now) {
  const [name, state, firmware, link] = row.children;
  const isUp = device.state === 'up';
  setText(name, `${device.name} · ${device.scope}`);
  state.className = !isThere ? 'quiet' : isUp ? 'good' : 'bad';
  const said = [DEVICE[device.state] + (isUp ? '' : ` for ${span(now - device.since_ms)}`), device.text].filter(Boolean).join(': ');
  setText(state, isThere ? said : `last known: ${said}`);
  const uptime = isThere && isUp && device.reset_ms !== null ? `uptime ${span(now - device.reset_ms)}` : '';
  setText(firmware, [device.firmware, uptime].filter(Boolean).join(' · '));
  firmware.hidden = firmware.textContent === '';
  const ms = (us) => (us / 1000).toFixed(2);
  const trip = device.round_trip_us;
  setText(link, [
    trip ? `round trip ${ms(trip[0])} ms, 99 % ${ms(trip[1])} ms` : 'no round trip yet',
    ...[['resets', device.resets], ['lost', device.lost], ['errors', device.errors], ['resent', device.repeats]]
      .map(([what, count]) => `${what}\u00a0${count}`),
  ].join(' · '));
}

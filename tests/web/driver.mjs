// Drives Chromium for one scenario of tests/web/page.rs: node driver.mjs SCENARIO URL DIRECTORY [PAGES].
// Prints `do: WHAT` when the test has to do something outside the browser, and waits for a line.

import assert from 'node:assert/strict';
import { readFileSync, rmSync, writeFileSync } from 'node:fs';
import { createServer } from 'node:http';
import { connect, createServer as createProxy } from 'node:net';
import { createRequire } from 'node:module';
import { createInterface } from 'node:readline';

const [scenario, url, directory, pages] = process.argv.slice(2);
const require = createRequire(`${process.env.ZTL_CLIENTS}/`);
const { chromium } = require('playwright-core');
const axe = readFileSync(require.resolve('axe-core/axe.min.js'), 'utf8');
const SIZES = { phone: [390, 844], tablet: [820, 1180], desk: [1440, 900] };
const LIMIT = 20_000;

const browser = await chromium.launchPersistentContext(`${directory}/profile`, {
  executablePath: '/usr/bin/chromium',
  headless: true,
  hasTouch: true,
  ignoreHTTPSErrors: true,
  args: ['--no-sandbox', '--disable-gpu', '--disable-quic', '--no-first-run', '--disable-background-networking',
    '--disable-component-update', '--disable-sync', '--host-resolver-rules=MAP hostile.test 127.0.0.1'],
});
browser.setDefaultTimeout(LIMIT);
const lines = createInterface({ input: process.stdin })[Symbol.asyncIterator]();

async function outside(what) {
  console.log(`do: ${what}`);
  await lines.next();
}

// An error in the page ends the scenario.
browser.on('weberror', (error) => { throw error.error(); });

async function open([width, height] = SIZES.desk, where = url) {
  const page = await browser.newPage();
  await page.setViewportSize({ width, height });
  page.alerts = 0;
  page.on('dialog', (dialog) => { page.alerts += 1; dialog.dismiss(); });
  page.sent = [];
  page.on('websocket', (socket) => socket.on('framesent', ({ payload }) => page.sent.push(JSON.parse(payload))));
  await page.goto(where);
  await page.locator('#connection[data-state=open]').waitFor();
  await page.locator('#component option').first().waitFor({ state: 'attached' });
  return page;
}

// Chooses a component of a robot, or any other of its scope: the text of the choice tells which.
async function choose(page, text, robot = 'ours') {
  const option = page.locator(`#component optgroup[label=${robot}] option`, { hasText: text }).first();
  await option.waitFor({ state: 'attached' });
  await page.locator('#component').selectOption(await option.getAttribute('value'));
}

// Starts a task of a component that is named by hand. A text that was written before goes into its form, if it has one.
async function start(page, component, goal) {
  await choose(page, 'another of');
  await page.locator('#other').fill('');
  await page.locator('#goal').fill(goal);
  await page.locator('#other').fill(component);
  await ready(page);
  await page.locator('#start').click();
}

// The field for the goal: of a form with one field, or the text.
const goalOf = (page) => page.locator('#goal:visible, #fields input:not([type]):visible');

// Waits until a press on Start counts again.
const ready = (page) => page.locator('#start[aria-disabled=false]').waitFor();
// Waits until a press on the show counts again: one within 0.6 s of another counts as the same, and the page does not show for
// how long.
const settle = (page) => page.waitForTimeout(700);
// A click or a key within so many ms of the one before belongs to it. The page's own limits are 100 ms longer.
const SAME_CLICK = 500;
const SAME_KEY = 1000;
// Notes when the page hears of clicks and keys.
const notePresses = (page) => page.evaluate(() => {
  window.presses = { click: [], keydown: [] };
  for (const [name, times] of Object.entries(window.presses)) addEventListener(name, () => times.push(performance.now()), true);
});
// Whether each click or key since the last call came within the limit after the one before. A busy machine may delay one.
const belongTogether = (page, name, limit) => page.evaluate(([event, most]) => {
  const times = [...window.presses[event]];
  for (const all of Object.values(window.presses)) all.length = 0;
  return times.every((time, nth) => nth === 0 || time - times[nth - 1] < most);
}, [name, limit]);
const isOff = async (page) => await page.locator('#start').getAttribute('aria-disabled') === 'true';

// Waits until the show says this of itself.
const showState = (page, text) => page.locator('#show-state', { hasText: text }).waitFor();

const saying = (page, list, text) => page.locator(`${list} .card`, { hasText: text });

// Stop lies within the screen of a phone, and nothing is wider than it.
async function checkPhone(page, name) {
  const [stop, whole] = await page.evaluate(() => {
    const { left, top, right, bottom } = document.getElementById('stop').getBoundingClientRect();
    return [[left, top, right, bottom].map(Math.round), document.documentElement.scrollWidth];
  });
  const [width, height] = SIZES.phone;
  assert.equal(whole, width, `${name}: wider than the window`);
  assert.ok(stop[0] >= 0 && stop[1] >= 0 && stop[2] <= width && stop[3] <= height, `${name}: Stop is at ${stop}`);
}

// No violation of axe's rules, and nothing wider than the window.
async function check(page, name) {
  // The page's policy allows no script of others; the driver's own channel does.
  const cdp = await browser.newCDPSession(page);
  await cdp.send('Runtime.evaluate', { expression: axe });
  const found = await cdp.send('Runtime.evaluate', {
    expression: 'axe.run().then((r) => r.violations.map((v) => v.id + ": " + v.nodes.map((n) => n.html).join(" ")))',
    awaitPromise: true, returnByValue: true,
  });
  assert.deepEqual(found.result.value, [], name);
  const [inner, whole] = await page.evaluate(() => [innerWidth, document.documentElement.scrollWidth]);
  assert.equal(whole, inner, `${name}: wider than the window`);
  await page.screenshot({ path: `${process.env.ZTL_SCREENSHOTS ?? directory}/${name}.png` });
}

const scenarios = {
  // Each part at each size, in light and dark, and by the keyboard.
  async parts() {
    for (const [name, size] of Object.entries(SIZES)) {
      const page = await open(size);
      await page.emulateMedia({ colorScheme: name === 'tablet' ? 'dark' : 'light' });
      await start(page, 'test/echo', 'hello');
      await saying(page, '#goals', 'COMPLETED: hello').waitFor();
      await saying(page, '#goals', 'hello').getByText('Again').click();
      assert.equal(await page.locator('#goal').inputValue(), 'hello');
      await start(page, 'test/sleep', '60');
      await saying(page, '#running', /by operator \d+ at 127\.0\.0\.1/).waitFor();
      await saying(page, '#robot-list', 'MISSING').waitFor();
      await check(page, name);
      await saying(page, '#running', 'test:sleep:60').getByText('Abort').click();
      await saying(page, '#goals', 'ABORTED').waitFor();
      await page.locator('#idle').waitFor();
      // By keys: a goal with Enter, and Stop with Escape while the text field has the focus.
      await goalOf(page).fill('50');
      await ready(page);
      await goalOf(page).press('Enter');
      await saying(page, '#running', 'test:sleep:50').waitFor();
      await goalOf(page).press('Escape');
      await page.getByText('ours: confirmed: 1 task has ended').waitFor();
      await page.getByText('gone: NOT CONFIRMED').waitFor();
      await page.getByText('NOT every robot has confirmed').waitFor();
      await saying(page, '#goals', 'sleep 50').getByText('ABORTED').waitFor();
      await check(page, `${name}-stopped`);
      // One press counts also while the list of components is open.
      if (name === 'desk') {
        await page.locator('#stopped-close').click();
        await page.locator('#component').click();
        await page.keyboard.press('Escape');
        await page.getByText('ours: confirmed: nothing ran').waitFor();
        await page.getByText('NOT every robot has confirmed').waitFor();
      }
      // A second press hides nothing of what the first one has said.
      await page.keyboard.press('Escape');
      await page.locator('#stopped-before', { hasText: `ours: confirmed: ${name === 'desk' ? 'nothing ran' : '1 task has ended'}` }).waitFor();
      await page.locator('#stopped-title', { hasText: 'NOT every robot has confirmed' }).waitFor();
      await page.locator('#stopped-close').click();
      await page.close();
    }
  },

  // Devices at each size; then one of them is lost, and its gateway.
  async devices() {
    const device = (page, text) => page.locator('.devices li', { hasText: text });
    for (const [name, size] of Object.entries(SIZES)) {
      const page = await open(size);
      await page.emulateMedia({ colorScheme: name === 'tablet' ? 'dark' : 'light' });
      const arm = device(page, 'arm · /test');
      await arm.locator('.good', { hasText: /^up$/ }).waitFor();
      await arm.getByText(/^gripper \S+ · uptime \d+ s$/).waitFor();
      await arm.getByText(/^round trip [\d.]+ ms, 99 % [\d.]+ ms · resets\s0 · lost\s\d+ · errors\s\d+ · resent\s\d+$/).waitFor();
      await device(page, 'wrist · /test').locator('.bad', { hasText: /^NOT THERE for \d+ s: .*no.such.port/ }).waitFor();
      await saying(page, '#robot-list', 'evil').getByText('3 more devices are not shown').waitFor();
      await device(page, '<img src=x onerror=alert(1)><script>alert(2)</script>\\u202e').first().waitFor();
      assert.equal(await page.locator('main img, main script').count(), 0);
      assert.equal(page.alerts, 0);
      assert.equal(await saying(page, '#robot-list', 'plain').locator('.devices').isVisible(), false);
      const clipped = await page.locator('.devices li').evaluateAll((all) => all.filter((it) => it.scrollWidth > it.clientWidth).length);
      assert.equal(clipped, 0, `${name}: devices are clipped`);
      if (name === 'phone') await checkPhone(page, 'devices');
      await page.locator('#robots').scrollIntoViewIfNeeded();
      await arm.scrollIntoViewIfNeeded();
      await check(page, `devices-${name}`);
      if (name === 'desk') {
        await outside('kill the device');
        await arm.locator('.bad', { hasText: /^SILENT for \d+ s: / }).waitFor();
        await outside('start the device');
        await arm.locator('.good', { hasText: /^up$/ }).waitFor();
        await arm.getByText(/ · resets\s1 · lost\s[1-9]\d* · /).waitFor();
        await outside('kill the gateway');
        await arm.locator('.quiet', { hasText: 'last known: up' }).waitFor();
      }
      await page.close();
    }
  },

  // The show at each size: scenes, cues by tap and by key, a note, Stop, and a scene that is stopped.
  async show() {
    for (const [name, size] of Object.entries(SIZES)) {
      const page = await open(size);
      await page.emulateMedia({ colorScheme: name === 'phone' ? 'dark' : 'light' });
      await page.locator('#show').waitFor();
      await page.locator('#show-missing li', { hasText: 'gone: MISSING' }).waitFor();
      // Chosen by tap; what is played is what is shown.
      await settle(page);
      await page.locator('#show-scenes button', { hasText: 'second' }).click();
      await page.locator('#show-play', { hasText: 'Play: second' }).waitFor();
      await settle(page);
      const where = () => page.locator('#show-play').evaluate((it) => it.getBoundingClientRect().top + scrollY);
      const place = await where();
      // Two impatient presses play once.
      await page.locator('#show-play').dblclick();
      await showState(page, 'Plays: second');
      await page.locator('#show-steps li', { hasText: 'test:mark:two accepted' }).first().waitFor();
      await page.locator('#show-cues button', { hasText: 'say' }).click();
      await page.locator('#show-cues li', { hasText: 'test:echo:hello completed' }).waitFor();
      // A held key is one press; in a text field it is text.
      await page.locator('#goal').press('h');
      await page.locator('#goal').fill('');
      await page.locator('#show-state').click();
      for (let held = 0; held < 5; held += 1) await page.keyboard.down('h');
      await page.keyboard.up('h');
      await page.locator('#show-cues li', { hasText: 'test:mark:cue accepted' }).waitFor();
      if (name === 'desk') {
        // As a remote desktop repeats a held key: each time pressed and let go.
        const cues = () => page.sent.filter((message) => message.service === '/ztl/show/cue').length;
        await notePresses(page);
        for (let isOne = false; !isOne;) {
          // After this time a key counts as a new press.
          await page.waitForTimeout(1200);
          const before = cues();
          for (let repeat = 0; repeat < 10; repeat += 1) {
            await page.keyboard.press('s');
            await page.waitForTimeout(repeat === 0 ? 660 : 33);
          }
          isOne = await belongTogether(page, 'keydown', SAME_KEY);
          if (isOne) assert.equal(cues(), before + 1);
        }
      }
      await page.locator('#show-note-text').fill(`<b>note</b> of the ${name}`);
      await page.locator('#show-note-text').press('Enter');
      await page.locator('#show-notes li', { hasText: `<b>note</b> of the ${name}` }).waitFor();
      assert.equal(await where(), place, 'Play has moved');
      await check(page, `show-${name}`);
      await page.locator('#show-stop').click();
      await showState(page, 'Next: second');
      await page.locator('#show-stopped li', { hasText: 'stopped: test:mark:two' }).waitFor();
      await saying(page, '#running', 'test:mark:cue').waitFor();
      await settle(page);
      await page.locator('#show-play').click();
      await showState(page, 'Plays: second');
      await page.locator('#show-steps li', { hasText: 'test:mark:two accepted' }).first().waitFor();
      await settle(page);
      // A double tap pauses, and does not go on at once.
      const pauses = page.locator('#show-commands [data-do=pause]');
      const refused = page.getByText('NOT SENT: the show changed as you pressed');
      for (;;) {
        const begun = performance.now();
        await pauses.click();
        await pauses.getByText('Go on after pause').waitFor();
        await pauses.click();
        if (await refused.isVisible()) break;
        // On a busy machine the second tap may come so late that it counts.
        assert.ok(performance.now() - begun > 600, 'a double tap went on');
        await pauses.getByText('Pause after step').waitFor();
        await settle(page);
      }
      await showState(page, 'a pause follows this step');
      await page.keyboard.press('Escape');
      await page.getByText('Stopped: every robot has confirmed').waitFor();
      await showState(page, 'Next: second');
      await check(page, `show-${name}-stopped`);
      await page.locator('#stopped-close').click();
      // A question of the script is answered by a tap.
      await settle(page);
      await page.locator('#show-scenes button', { hasText: 'ask' }).click();
      await page.locator('#show-play', { hasText: 'Play: ask' }).waitFor();
      const cut = await page.locator('#show-play').evaluate((it) => it.scrollWidth > it.clientWidth || it.scrollHeight > it.clientHeight);
      assert.equal(cut, false, 'the name on Play is cut');
      await settle(page);
      await page.locator('#show-play').click();
      await showState(page, 'DECIDE: a task failed');
      await settle(page);
      await page.emulateMedia({ colorScheme: name === 'phone' ? 'light' : 'dark' });
      await check(page, `show-${name}-asks`);
      await page.getByRole('button', { name: 'Go on anyway' }).click();
      await showState(page, 'The last scene is over.');
      await settle(page);
      await page.getByRole('button', { name: 'Restart' }).click();
      await showState(page, 'Next: first');
      await page.close();
    }
  },

  // The report of the show and its record, while it runs, at each size.
  async record() {
    let length = 0;
    for (const [name, size] of Object.entries(SIZES)) {
      const page = await open(size);
      await page.emulateMedia({ colorScheme: name === 'phone' ? 'dark' : 'light' });
      const note = `<img src=x onerror=alert(3)> of the ${name}`;
      await page.locator('#show-note-text').fill(note);
      await page.locator('#show-note-text').press('Enter');
      await page.locator('#show-notes li', { hasText: note }).waitFor();
      if (name === 'phone') {
        await settle(page);
        await page.locator('#show-play').click();
        await page.locator('#show-state', { hasText: 'DECIDE: a task failed' }).waitFor();
      }
      await page.locator('#record-links').scrollIntoViewIfNeeded();
      await check(page, `record-${name}`);
      const opened = browser.waitForEvent('page');
      await page.getByText('Report of the show so far').click();
      const report = await opened;
      report.alerts = 0;
      report.on('dialog', (dialog) => { report.alerts += 1; dialog.dismiss(); });
      const refused = [];
      report.on('console', (message) => { if (message.type() === 'error') refused.push(message.text()); });
      await report.setViewportSize({ width: size[0], height: size[1] });
      await report.emulateMedia({ colorScheme: name === 'phone' ? 'dark' : 'light' });
      await report.reload();
      assert.equal(new URL(report.url()).pathname, '/report');
      await report.getByText(note).first().waitFor();
      await report.locator('.timeline:visible').first().waitFor();
      assert.equal(await report.locator('img, script').count(), 0);
      assert.equal(await report.getByText('damaged').count(), 0);
      // Its style counts.
      assert.equal(await report.locator('svg.defs').first().evaluate((it) => getComputedStyle(it).position), 'absolute');
      assert.deepEqual([report.alerts, refused], [0, []]);
      // No script runs in it, not even the driver's: that checks a copy.
      const copy = await browser.newPage();
      await copy.setViewportSize({ width: size[0], height: size[1] });
      await copy.emulateMedia({ colorScheme: name === 'phone' ? 'dark' : 'light' });
      await copy.setContent(await report.content());
      await check(copy, `report-${name}`);
      await copy.close();
      await report.screenshot({ path: `${process.env.ZTL_SCREENSHOTS ?? directory}/report-${name}.png` });
      await report.close();
      const downloading = page.waitForEvent('download');
      await page.getByText('Download its record').click();
      const download = await downloading;
      assert.equal(download.suggestedFilename(), 'run_1.jsonl');
      const lines = readFileSync(await download.path(), 'utf8').trim().split('\n').map((line) => JSON.parse(line));
      assert.ok(lines.some((line) => line.event === 'note' && line.text.endsWith(note)));
      assert.ok(lines.length > length, 'it has grown');
      length = lines.length;
      assert.equal(await page.locator('#connection').getAttribute('data-state'), 'open');
      await page.close();
    }
  },

  // Skip, Pause, Go on, Replay and Retry.
  async commands() {
    const page = await open();
    const released = `${directory}/released`;
    const press = async (name) => {
      await settle(page);
      await page.locator('#show-commands').getByRole('button', { name }).click();
    };
    const play = async () => {
      await settle(page);
      await page.locator('#show-play').click();
    };
    const pause = async () => {
      await press('Pause after step');
      await showState(page, 'a pause follows this step');
    };
    const step = (text) => page.locator('#show-steps li', { hasText: text }).first().waitFor();
    const scene = (text) => page.locator('#show-scenes button', { hasText: text }).waitFor();
    await page.getByText('The show is not recorded. Started with --record').waitFor();
    assert.equal(await page.locator('#record-links').isVisible(), false);
    await showState(page, 'Next: skipped');
    await press('Skip');
    await showState(page, 'Next: played');
    await scene('− 1 skipped');
    await play();
    await step('test:held:1 accepted');
    await pause();
    writeFileSync(released, '');
    await showState(page, 'PAUSE: played');
    await step('test:echo:said planned');
    await check(page, 'show-pause');
    await press('Go on after pause');
    await showState(page, 'Next: flaky');
    await scene('✓ 2 played');
    rmSync(released);
    await press('Replay last');
    await showState(page, 'Plays: played');
    // A pause that was ordered is taken back.
    await pause();
    await press('Go on after pause');
    await page.locator('#show-state', { hasText: 'a pause follows this step' }).waitFor({ state: 'hidden' });
    writeFileSync(released, '');
    await showState(page, 'Next: flaky');
    await play();
    await showState(page, 'DECIDE: a task failed');
    await showState(page, 'test:flaky:1');
    await step('test:flaky:1 failed');
    await press('Retry failed');
    await showState(page, 'The last scene is over.');
    await scene('✓ 3 flaky');
    await page.locator('#goals-box').waitFor({ state: 'hidden' });
    await page.locator('#idle').waitFor();
  },

  // A scene is stopped and played again while its robot hangs.
  async stuck() {
    const page = await open();
    await settle(page);
    await page.locator('#show-scenes button', { hasText: 'second' }).click();
    await page.locator('#show-play', { hasText: 'Play: second' }).waitFor();
    await settle(page);
    await page.locator('#show-play').click();
    await saying(page, '#running', 'test:mark:two').waitFor();
    await page.locator('#show-steps li', { hasText: 'test:mark:two accepted' }).first().waitFor();
    await outside('suspend the robot');
    await page.locator('#show-stop').click();
    await showState(page, 'Stopping: second');
    assert.equal(await page.locator('#show-play').getAttribute('aria-disabled'), 'true');
    await page.locator('#show-stopped li', { hasText: 'NOT CONFIRMED: test:mark:two' }).waitFor();
    await showState(page, 'Next: second');
    await check(page, 'show-stuck');
    await settle(page);
    await page.locator('#show-play').click();
    await showState(page, 'Plays: second');
    await outside('continue the robot');
    // What was stopped ends, and what was played then runs.
    await page.locator('#show-steps li', { hasText: 'test:mark:two accepted' }).first().waitFor();
    await page.locator('#ended-box summary').click();
    await saying(page, '#ended', 'test:mark:two').getByText('ABORTED').waitFor();
    assert.equal(await saying(page, '#running', 'test:mark:two').count(), 1);
    await page.locator('#show-stop').click();
    await showState(page, 'Next: second');
    await page.locator('#idle').waitFor();
  },

  // The operator's page while its timers are slow, as those of a tab in the background, and then while its script hangs.
  async hangs() {
    const page = await browser.newPage();
    await page.addInitScript(() => {
      const [later, often] = [setTimeout, setInterval];
      window.setTimeout = (act) => later(act, 60_000);
      window.setInterval = (act) => often(act, 60_000);
      window.hang = () => later(() => { for (;;); }, 0);
    });
    await page.goto(url);
    await page.locator('#show-scenes button', { hasText: 'quick' }).waitFor();
    await settle(page);
    await page.locator('#show-scenes button', { hasText: 'quick' }).click();
    await page.locator('#show-play', { hasText: 'Play: quick' }).waitFor();
    await settle(page);
    await page.locator('#show-play').click();
    await page.locator('#show-steps li', { hasText: 'test:sleep:61 accepted' }).first().waitFor();
    await outside('look: slow');
    await page.evaluate(() => { window.hang(); });
    await outside('look: hangs');
  },

  // Text of robots and of goals is shown as it is.
  async hostile() {
    const page = await open();
    const evil = '<img src=x onerror=alert(1)><script>alert(2)</script>"\'&\u202e';
    await start(page, 'test/echo', evil);
    // What turns the direction of a text is written out.
    await saying(page, '#goals', `COMPLETED: ${evil.replace('\u202e', '\\u202e')}`).waitFor();
    await start(page, 'x/echo', 'W'.repeat(300));
    await page.locator('#ended-box summary').click();
    await saying(page, '#ended', '<img src=x').waitFor();
    assert.equal(await page.locator('main img, main script').count(), 0);
    assert.equal(page.alerts, 0);
    const long = 'x '.repeat(5000);
    await start(page, 'test/echo', `${long}end`);
    const card = saying(page, '#goals', 'COMPLETED: x x').first();
    await card.waitFor();
    assert.ok((await card.textContent()).length < 1000);
    await card.getByText(/^Show all/).last().click();
    await card.getByText(`COMPLETED: ${long}end`).waitFor();
    await card.getByText('Show less').click();
    await check(page, 'hostile');
    // No text makes the page wider than a phone, or moves Stop off its screen.
    const cdp = await browser.newCDPSession(page);
    const [width, height] = SIZES.phone;
    await cdp.send('Emulation.setDeviceMetricsOverride', { width, height, deviceScaleFactor: 2, mobile: true });
    await checkPhone(page, 'goals');
    for (const component of ['about', 'number', 'words', 'fields']) {
      await choose(page, `long ${component}`);
      await page.locator('#about', { hasText: 'https://' }).waitFor();
      await checkPhone(page, component);
    }
    await page.locator('#fields input[type=checkbox]').first().check();
    await checkPhone(page, 'fields');
    // The field for a text shows what is in it; the line below, what it really is.
    await choose(page, 'long about');
    await page.locator('#fields input').first().fill('a\u202eb\u0007');
    await page.locator('#sends', { hasText: 'sends: a\\u202eb\\u0007' }).waitFor();
    await page.keyboard.press('Escape');
    await page.getByText('ours: confirmed').waitFor();
    await checkPhone(page, 'stopped');
  },

  // Two pages see the same, and a task of anybody can be aborted on each. One of them starts tasks.
  async two() {
    const [one, other] = [await open(), await open(SIZES.phone)];
    await one.getByText('Nobody operates').waitFor();
    await start(one, 'test/sleep', '60');
    await one.getByText('You operate. Others see operator 1 at 127.0.0.1.').waitFor();
    await other.getByText('operator 1 at 127.0.0.1 operates.').waitFor();
    await choose(other, 'another of');
    await other.locator('#goal').fill('61');
    await other.locator('#other').fill('test/sleep');
    await other.locator('#sends', { hasText: 'sends: 61' }).waitFor();
    assert.ok(await isOff(other));
    await goalOf(other).press('Enter');
    await other.getByText(/NOT SENT: operator \d+ at 127\.0\.0\.1 operates/).waitFor();
    await check(other, 'not-operating');
    await saying(other, '#running', 'test:sleep:60').getByText('Abort').click();
    await saying(one, '#goals', 'ABORTED').waitFor();
    await other.locator('#take-over').click();
    await other.getByText('You operate.').waitFor();
    await one.getByText('operator 2 at 127.0.0.1 has taken over').waitFor();
    assert.ok(await isOff(one));
    await check(one, 'taken-over');
    await other.locator('#start').click();
    await saying(one, '#running', 'test:sleep:61').waitFor();
    await one.locator('#stop').click();
    await other.getByText('ours: confirmed: 1 task has ended').waitFor();
    await saying(other, '#goals', 'ABORTED').waitFor();
    // What was confirmed says nothing of what is started after it. The button names the robot that it moves.
    await one.getByText('Stopped: every robot has confirmed').waitFor();
    assert.equal(await other.locator('#start').textContent(), 'Start on ours');
    for (const goal of ['62', '63']) {
      await ready(other);
      await goalOf(other).fill(goal);
      await other.locator('#start').click();
      await saying(one, '#running', `test:sleep:${goal}`).waitFor();
    }
    await one.getByText('Every robot had confirmed, but tasks run again').waitFor();
    // A press on an Abort that has just come to where another one was aborts nothing.
    const pressed = one.evaluate(() => new Promise((done) => {
      const list = document.getElementById('running');
      new MutationObserver((changes, observer) => {
        if (!changes.some((change) => change.removedNodes.length)) return;
        observer.disconnect();
        list.querySelector('button').click();
        done();
      }).observe(list, { childList: true });
    }));
    await saying(other, '#running', 'test:sleep:62').getByText('Abort').click();
    await pressed;
    await one.getByText('NOT SENT: the list moved as you pressed').waitFor();
    await saying(one, '#running', 'test:sleep:63').waitFor();
    // Whoever leaves does not operate any longer.
    await other.close();
    await one.getByText('Nobody operates').waitFor();
  },

  // One press starts one task: a double click, a double tap, and an Enter held in the field or on the button.
  async presses() {
    const page = await open();
    await choose(page, 'another of');
    await page.locator('#other').fill('test/mark');
    await notePresses(page);
    // Checks the number of goals. A press that came late may have started one more: then the test begins again.
    const goals = async (count, name = 'click', limit = Infinity) => {
      await page.locator('#running .card').nth(count - 1).waitFor();
      await ready(page);
      if (!await belongTogether(page, name, limit)) {
        console.log('a press came late');
        return false;
      }
      assert.equal(await page.locator('#goals .card').count(), count);
      return true;
    };
    const goal = (text) => page.locator('#goal').fill(text);
    await goal('click');
    await page.locator('#start').dblclick();
    if (!await goals(1, 'click', SAME_CLICK)) return;
    await page.getByText('Presses that follow at once do not count').waitFor();
    await goal('tap');
    const box = await page.locator('#start').boundingBox();
    for (let tap = 0; tap < 3; tap += 1) await page.touchscreen.tap(box.x + 20, box.y + 20);
    if (!await goals(2, 'click', SAME_CLICK)) return;
    for (const [count, where] of [[3, '#goal'], [4, '#start']]) {
      await goal(where);
      await page.locator(where).focus();
      for (let repeat = 0; repeat < 15; repeat += 1) {
        await page.keyboard.down('Enter');
        await page.waitForTimeout(33);
      }
      await page.keyboard.up('Enter');
      await goals(count);
    }
    // As a remote desktop repeats a held key: each time pressed and let go.
    await goal('remote');
    await page.locator('#goal').focus();
    for (let repeat = 0; repeat < 45; repeat += 1) {
      await page.keyboard.press('Enter');
      await page.waitForTimeout(repeat === 0 ? 660 : 33);
    }
    if (!await goals(5, 'keydown', SAME_KEY)) return;
    // The same goal twice, by two presses.
    await page.locator('#start').click();
    await goals(6);
  },

  // What was chosen stays chosen when it vanishes, and nothing else is started instead.
  async gone() {
    const page = await open();
    const value = () => page.locator('#component').evaluate((select) => JSON.parse(select.value || 'null'));
    assert.equal(await value(), null);
    assert.ok(await isOff(page));
    await choose(page, 'test mark', 'second');
    const chosen = await value();
    assert.equal(chosen.robot, 'second');
    await ready(page);
    const refused = async (why) => {
      assert.deepEqual(await value(), chosen);
      assert.ok(await isOff(page));
      await page.locator('#goal').press('Enter');
      await page.locator('#form-said', { hasText: why }).waitFor();
    };
    await outside('kill the second');
    await page.getByText('second is missing.').waitFor();
    await refused('NOT SENT: second is missing');
    await outside('start the second without mark');
    await page.getByText('test mark of second is gone').waitFor();
    assert.equal(await page.locator('#component option:checked').textContent(), 'test mark (gone)');
    await refused('NOT SENT: test mark of second is gone');
    await check(page, 'gone');
    await outside('start the second with mark');
    await ready(page);
    assert.deepEqual(await value(), chosen);
    await page.locator('#start').click();
    await saying(page, '#running', 'test:mark').waitFor();
  },

  // A form for each kind of goal. What is sent is what the form shows.
  async forms() {
    const page = await open();
    const goal = page.locator('#goal');
    const field = (label) => page.locator('#fields').getByLabel(label, { exact: true });
    const sends = (text) => page.locator('#sends', { hasText: text }).waitFor();
    const completes = async (text) => {
      await sends(`sends: ${text}`);
      await ready(page);
      await page.locator('#start').click();
      await saying(page, '#goals', `COMPLETED: ${text}`).waitFor();
    };
    const refused = async (why) => {
      await page.locator('#start').press('Enter');
      await page.getByText(`NOT SENT: ${why}`).waitFor();
    };
    // Until it has said what it takes, nothing is started.
    const turn = await page.locator('#component option', { hasText: 'test turn' }).first().getAttribute('value');
    const asked = await page.evaluate((value) => {
      const select = document.getElementById('component');
      select.value = value;
      select.dispatchEvent(new Event('change'));
      return [document.getElementById('start').getAttribute('aria-disabled'), document.getElementById('why-not').textContent];
    }, turn);
    assert.deepEqual(asked, ['true', 'Asking what it takes.']);
    await page.locator('#about', { hasText: 'turns the head · for example 45 · usually takes 2 s' }).waitFor();
    await refused('The goal is not complete');
    // Nothing is chosen for the person: only what is moved or written counts.
    await field('Goal: slider').focus();
    await page.keyboard.press('ArrowRight');
    await completes('-85');
    assert.equal(await field('Goal (deg)').inputValue(), '-85');
    await field('Goal (deg)').fill('91');
    await page.locator('#fields').getByText('This is not a number from -90 to 90 deg.').waitFor();
    assert.equal(await field('Goal (deg)').getAttribute('aria-invalid'), 'true');
    await check(page, 'form-wrong');
    // When presses count again.
    await page.waitForTimeout(1200);
    await refused('The goal is not complete');
    await field('Goal (deg)').fill('12.5');
    assert.equal(await field('Goal: slider').inputValue(), '15');
    await completes('12.5');
    // As text, the console checks it.
    await page.locator('#as-text').check();
    assert.equal(await goal.inputValue(), '12.5');
    await goal.fill('91');
    await ready(page);
    await page.locator('#start').click();
    await saying(page, '#goals', "NOT_STARTED: the goal '91' is not a number from -90 to 90 deg").waitFor();
    await choose(page, 'test count');
    await field('Goal').fill('1.5');
    await page.locator('#fields').getByText('This is not a whole number from 1 to 123456789012.').waitFor();
    await field('Goal').fill('3');
    await completes('3');
    await field('Goal: slider').focus();
    await page.keyboard.press('End');
    await sends('sends: 123456789012');
    // The least value, too, although the slider stands there already.
    await field('Goal').fill('');
    await choose(page, 'test turn');
    await choose(page, 'test count');
    await sends('sends nothing yet');
    await field('Goal: slider').focus();
    await page.keyboard.press('Home');
    await sends('sends: 1');
    await choose(page, 'test say');
    // Nothing is not an empty text, unless the person says so.
    await sends('sends nothing yet');
    assert.ok(await isOff(page));
    await field('Send an empty text: Goal').check();
    await sends('sends an empty goal');
    await field('Goal').fill('too long');
    await page.locator('#fields').getByText('This is not a text of at most 5 characters.').waitFor();
    await field('Goal').fill('grüß!');
    await completes('grüß!');
    // Words by keys.
    await choose(page, 'test side');
    await field('straight on').focus();
    await page.keyboard.press('ArrowRight');
    await completes('right');
    await choose(page, 'test light');
    await page.locator('.word', { hasText: 'True' }).click();
    await completes('True');
    await choose(page, 'test home');
    await sends('sends an empty goal');
    await ready(page);
    await page.locator('#start').click();
    await saying(page, '#goals', 'test/home').getByText('COMPLETED').waitFor();
    await choose(page, 'test way');
    await sends('sends nothing yet');
    await field('Send an empty list: Goal').check();
    await sends('sends: []');
    for (const value of ['1', '2.5', '11']) {
      await field('Add to Goal').click();
      await page.keyboard.type(value);
    }
    await page.locator('#fields').getByText('This is not a number of at most 10.').waitFor();
    await field('Remove Goal 3').click();
    await completes('[1, 2.5]');
    await choose(page, 'test grasp');
    await field('force (N)').fill('7');
    await page.locator('.word', { hasText: 'left' }).click();
    assert.equal(await field('words').isVisible(), false);
    await completes('{"force": 7, "hand": "left"}');
    await field('Give words (otherwise ok)').check();
    await field('words').fill('a "b"');
    await completes('{"force": 7, "hand": "left", "words": "a \\"b\\""}');
    for (const [name, size] of Object.entries(SIZES)) {
      await page.setViewportSize({ width: size[0], height: size[1] });
      await page.emulateMedia({ colorScheme: name === 'tablet' ? 'dark' : 'light' });
      await check(page, `form-${name}`);
    }
    // A component that is named by hand has its form, too; a text that was written before stays.
    await choose(page, 'another of');
    await goal.fill('15');
    await page.locator('#other').fill('test/turn');
    await sends('sends: 15');
    assert.equal(await field('Goal (deg)').inputValue(), '15');
    await completes('15');
    await page.locator('#other').fill('test/count');
    await sends('sends nothing yet');
    await page.locator('#other').fill('test/free');
    await goal.fill('x');
    await ready(page);
    assert.equal(await page.locator('#as-text').isVisible(), false);
    // A goal that was sent fills in the fields again.
    await choose(page, 'test free');
    await goal.waitFor();
    assert.equal(await page.locator('#as-text').isVisible(), false);
    await saying(page, '#goals', 'test/grasp').first().getByText('Again').click();
    await sends('sends: {"force": 7, "hand": "left", "words": "a \\"b\\""}');
    await saying(page, '#goals', 'test/turn -85').getByText('Again').click();
    await sends('sends: -85');
    await field('Goal (deg)').fill('70');
    await sends('sends: 70');
    // What it takes changes, and what was written stays, unless its unit is another one. A press at that moment was
    // meant for what it took before.
    const other = await open();
    await choose(other, 'test grasp');
    await other.locator('#fields').getByLabel('force (N)', { exact: true }).fill('7');
    const pressed = page.evaluate(() => new Promise((done) => {
      const said = document.getElementById('form-said');
      new MutationObserver((_, observer) => {
        if (!said.textContent.includes('has changed')) return;
        observer.disconnect();
        document.getElementById('start').click();
        done(said.textContent);
      }).observe(said, { childList: true });
    }));
    // Until it has said what it takes now, nothing is started.
    await page.evaluate(() => {
      const why = document.getElementById('why-not');
      new MutationObserver(() => { window.asked ||= why.textContent === 'Asking what it takes.'; }).observe(why, { childList: true });
    });
    await field('Goal (deg)').fill('50');
    const count = await page.locator('#goals .card').count();
    await outside('change the robot');
    const said = await pressed;
    assert.ok(await page.evaluate(() => window.asked));
    assert.equal(said, 'NOT SENT: what it takes changed as you pressed. Look, and press again.');
    await page.locator('#fields').getByText('a number from -90 to 60 deg', { exact: true }).waitFor();
    assert.equal(await field('Goal (deg)').inputValue(), '50');
    await ready(page);
    assert.equal(await page.locator('#goals .card').count(), count);
    await other.getByText('What test grasp takes has changed: enter the goal again.').waitFor();
    assert.equal(await other.locator('#fields').getByLabel('force (kN)', { exact: true }).inputValue(), '');
  },

  // The console of the demo: what a number of a device takes, one that moves, and a Stop. The pictures of docs/web.md.
  async demo() {
    const page = await open(SIZES.phone);
    const finger = async (goal) => {
      await choose(page, 'gripper finger', 'demo');
      await page.locator('#fields input:not([type=range])').fill(goal);
      await ready(page);
      await page.locator('#start').click();
    };
    await finger('0');
    await saying(page, '#goals', 'finger 0').getByText('COMPLETED').waitFor();
    await finger('100');
    await saying(page, '#running', 'gripper:finger:100').waitFor();
    await check(page, 'web-phone');
    await saying(page, '#goals', 'finger 100').getByText('COMPLETED').waitFor();
    await outside('slow the gripper');
    await finger('20');
    await saying(page, '#running', 'gripper:finger:20').waitFor();
    await page.locator('#stop').click();
    await page.getByText('demo: confirmed').waitFor();
    await saying(page, '#goals', 'finger 20').getByText('ABORTED').waitFor();
    await page.setViewportSize({ width: SIZES.desk[0], height: SIZES.desk[1] });
    await check(page, 'demo-desk');
  },

  // When each change of a task was in a message, in the document and on the screen of the last of some pages, and how
  // long the first paint takes over a slow network: for figures.rs.
  async figures() {
    await browser.addInitScript(() => {
      window.times = { heard: {}, shown: {}, painted: {} };
      const now = () => performance.timeOrigin + performance.now();
      const note = (what, names) => { for (const name of names) window.times[what][name] ??= now(); };
      const names = (tasks) => tasks.map((task) => `${task.task.split(':').at(-1)} ${task.runs}`);
      window.WebSocket = class extends WebSocket {
        constructor(...args) {
          super(...args);
          this.addEventListener('message', (event) => {
            if (event.data.includes('"/ztl/tasks"')) note('heard', names(JSON.parse(event.data).msg?.tasks ?? []));
          });
        }
      };
      let ran = new Set();
      addEventListener('DOMContentLoaded', () => new MutationObserver(() => {
        const runs = new Set([...document.querySelectorAll('#running .name')].map((name) => name.textContent.split(':').at(-1)));
        const changed = [...[...runs].filter((name) => !ran.has(name)).map((name) => `${name} true`),
          ...[...ran].filter((name) => !runs.has(name)).map((name) => `${name} false`)];
        ran = runs;
        note('shown', changed);
        // A message that is sent at the begin of a frame comes when it has been painted.
        const { port1, port2 } = new MessageChannel();
        port1.onmessage = () => note('painted', changed);
        requestAnimationFrame(() => port2.postMessage(''));
      }).observe(document.getElementById('now'), { childList: true, subtree: true, characterData: true }));
    });
    const opened = [];
    while (opened.length < Number(pages)) opened.push(await open());
    await outside('measure');
    const times = await opened.at(-1).evaluate(() => window.times);
    for (const [what, all] of Object.entries(times)) console.log(`${what}: ${JSON.stringify(all)}`);
    for (const page of opened) await page.close();
    const paints = [];
    for (let round = 0; round < 5; round += 1) {
      const slow = await browser.newPage();
      const cdp = await browser.newCDPSession(slow);
      await cdp.send('Network.enable');
      // "Fast 3G" of Chromium's developer tools.
      await cdp.send('Network.emulateNetworkConditions', {
        offline: false, latency: 562.5, downloadThroughput: 1.6e6 / 8 * 0.9, uploadThroughput: 750e3 / 8 * 0.9,
      });
      await slow.goto(url);
      const paint = () => slow.evaluate(() => performance.getEntriesByName('first-contentful-paint')[0]?.startTime);
      while (await paint() === undefined) await slow.waitForTimeout(50);
      paints.push(await paint());
      await slow.close();
    }
    console.log(`paints: ${JSON.stringify(paints)}`);
  },

  // When the page is back after the console was killed, and shows a server that is back: for figures.rs.
  async returns_in_time() {
    const page = await open();
    const until = (text) => page.evaluate((wanted) => new Promise((done) => {
      const look = () => {
        const [state, list] = ['connection', 'robot-list'].map((id) => document.getElementById(id));
        if (!`${state.dataset.state} ${list.textContent}`.includes(wanted)) return;
        watch.disconnect();
        done(Date.now());
      };
      const watch = new MutationObserver(look);
      watch.observe(document.body, { childList: true, subtree: true, characterData: true, attributes: true });
      look();
    }), text);
    for (const [what, lost, back] of [['console', 'lost', 'open'], ['server', 'MISSING', 'there for']]) {
      for (let round = 0; round < 5; round += 1) {
        await outside(`kill the ${what}`);
        await until(lost);
        const told = until(back);
        await outside(`start the ${what}`);
        console.log(`${what}: ${await told}`);
      }
    }
  },

  // Presses while the console does not answer.
  async impatient() {
    const page = await open();
    await choose(page, 'test mark');
    await page.locator('#goal').fill('x');
    await outside('suspend the console');
    await page.locator('#start').click();
    await saying(page, '#goals', 'sent').waitFor();
    await page.waitForTimeout(1200);
    await page.locator('#start').press('Enter');
    await page.getByText('NOT SENT: The goal before has no answer yet.').waitFor();
    await outside('continue the console');
    await saying(page, '#running', 'test:mark:x').waitFor();
    await ready(page);
    assert.equal(await page.locator('#goals .card').count(), 1);
  },

  // Each goal says until when it may start, by the console's clock, also if the clock of the browser is wrong.
  async deadline() {
    const page = await browser.newPage();
    const sent = [];
    page.on('websocket', (socket) => socket.on('framesent', ({ payload }) => sent.push(JSON.parse(payload))));
    await page.addInitScript(() => {
      const now = Date.now;
      Date.now = () => now() + 3_600_000;
    });
    await page.goto(url);
    await page.locator('#connection[data-state=open]').waitFor();
    await start(page, 'test/echo', 'in time');
    const before = Date.now();
    await saying(page, '#goals', 'COMPLETED: in time').waitFor();
    const goal = sent.find((message) => message.op === 'send_action_goal');
    const ahead = goal.args.not_after_ms - before;
    assert.ok(Number.isInteger(goal.args.not_after_ms) && ahead > 0 && ahead <= 5000, `${ahead} ms`);
  },

  // Goals that were kept, and the last ones, fill in the form and start nothing.
  async ready() {
    const page = await open();
    await start(page, 'test/echo', 'kept');
    await saying(page, '#goals', 'COMPLETED: kept').waitFor();
    await page.getByLabel('Keep test/echo kept of ours').click();
    for (let count = 0; count < 8; count += 1) {
      await start(page, 'test/echo', `${count}`);
      await saying(page, '#goals', `COMPLETED: ${count}`).waitFor();
    }
    await page.reload();
    assert.deepEqual(await page.locator('#ready .fill .name').allTextContents(),
      ['test/echo kept', ...[7, 6, 5, 4, 3, 2].map((count) => `test/echo ${count}`)]);
    await page.locator('#ready .fill').first().click();
    assert.equal(await page.locator('#goal').inputValue(), 'kept');
    await ready(page);
    assert.equal(await page.locator('#goals .card').count(), 0);
    await page.locator('#goal').press('Enter');
    await saying(page, '#goals', 'COMPLETED: kept').waitFor();
    // The robot has another name now: they are not sent to it by guessing.
    await page.evaluate(() => {
      const goals = JSON.parse(localStorage.getItem('ready-goals'));
      for (const goal of goals) goal.chosen.robot = 'old';
      localStorage.setItem('ready-goals', JSON.stringify(goals));
    });
    await page.reload();
    await page.locator('#ready .fill', { hasText: 'old (gone)' }).first().click();
    await page.getByText('No robot is named old: it may have another name now.').waitFor();
    await page.locator('#goal').press('Enter');
    await page.getByText('NOT SENT: No robot is named old').waitFor();
    assert.equal(await page.locator('#goals .card').count(), 0);
    await check(page, 'renamed');
  },

  // Streams are heard while their part is open.
  async streams() {
    const page = await open();
    assert.equal(await page.locator('#publishers .streams li').count(), 0);
    await outside('nobody listens');
    await page.locator('#publishers summary').click();
    const stream = (topic) => page.locator('#publishers .streams li', { hasText: topic });
    await stream('/lab/pose').getByText("{'x': ").waitFor();
    await stream('/lab/pose').locator('svg').waitFor();
    const points = () => stream('/lab/pose').locator('.line1').getAttribute('points');
    while ((await points()).split(' ').length < 5) await page.waitForTimeout(50);
    await stream('/lab/word').getByText('<b>hostile</b>').waitFor();
    const width = () => stream('/lab/camera').locator('img').evaluate((picture) => picture.naturalWidth);
    while (await width() !== 64) await page.waitForTimeout(50);
    await check(page, 'streams');
    await page.setViewportSize({ width: SIZES.phone[0], height: SIZES.phone[1] });
    await page.emulateMedia({ colorScheme: 'dark' });
    await stream('/lab/camera').scrollIntoViewIfNeeded();
    await check(page, 'streams-phone');
    await page.locator('#publishers summary').click();
    await outside('nobody listens');
  },

  // The console keeps the tasks that have ended, for every page.
  async past() {
    const page = await open();
    for (const [component, goal, end] of [['test/echo', 'one', 'COMPLETED'], ['test/sleep', 'x', 'NOT_STARTED'], ['test/sleep', '60', 'ABORTED']]) {
      await start(page, component, goal);
      if (end === 'ABORTED') await saying(page, '#running', 'test:sleep:60').getByText('Abort').click();
      await saying(page, '#goals', end).waitFor();
    }
    await outside('start a task');
    const other = await open(SIZES.tablet);
    await other.getByText('Tasks of the last hours').click();
    await saying(other, '#past', 'test:echo:other').waitFor();
    await saying(other, '#past', 'COMPLETED: one').getByText(/by operator \d+ at 127\.0\.0\.1/).waitFor();
    await other.locator('#past-filter').fill('abort');
    await saying(other, '#past', 'COMPLETED: one').waitFor({ state: 'detached' });
    await saying(other, '#past', 'ABORTED').waitFor();
    assert.equal(await other.locator('#past .card').count(), 1);
    await check(other, 'past');
    await other.locator('#past-filter').fill('nothing like this');
    await other.getByText('No task contains this.').waitFor();
  },

  // Whoever opens the page without its link is told what to do; so is a page whose console was started again.
  async locked() {
    const page = await open();
    await outside('start the console again');
    await page.getByText('No access: open the link again').waitFor();
    await page.reload();
    await page.getByText('Open the link again that ztl web printed').waitFor();
    await check(page, 'locked');
  },

  // The page that operated goes on when the console is back.
  async returns() {
    const page = await open();
    await start(page, 'test/mark', 'x');
    await page.getByText('You operate.').waitFor();
    await saying(page, '#running', 'test:mark:x').waitFor();
    await outside('kill the console');
    await saying(page, '#goals', 'UNKNOWN').waitFor();
    await page.getByText('You operate.').waitFor();
    await page.locator('#goal').fill('y');
    await ready(page);
    await page.locator('#start').click();
    await page.locator('#running .card').nth(1).waitFor();
  },

  // A page of one's own, with a button in a form.
  async own() {
    const page = await browser.newPage();
    await page.goto(url);
    assert.equal(await page.locator('p').evaluate((text) => getComputedStyle(text).color), 'rgb(255, 0, 0)');
    await page.locator('button').dblclick();
    await page.waitForLoadState();
    const console_ = await browser.newPage();
    await console_.goto(new URL('/console', url).href);
    await saying(console_, '#running', 'by page at 127.0.0.1').waitFor();
    assert.equal(await console_.locator('#running .card').count(), 1);
    // A second press, when the first one is long over.
    await console_.getByText(/started [1-9] s ago/).waitFor();
    await page.locator('button').click();
    await console_.locator('#running .card').nth(1).waitFor();
    // Who operates by the console goes before.
    await console_.locator('#component').selectOption({ label: 'test echo' });
    await console_.locator('#start').click();
    await console_.getByText('You operate.').waitFor();
    await console_.getByText(/started [2-9] s ago/).first().waitFor();
    await page.locator('button').click();
    await page.getByText(/NOT SENT: operator \d+ at 127\.0\.0\.1 operates/).waitFor();
  },

  // What a page started is aborted when it is closed, if it has chosen so.
  async closed() {
    const [one, other] = [await open(SIZES.tablet), await open()];
    await start(one, 'test/sleep', '60');
    await saying(other, '#running', 'test:sleep:60').waitFor();
    await one.locator('#when-gone').check();
    await one.locator('#connection[data-state=open]').waitFor();
    await check(one, 'when-gone');
    await one.close();
    await other.locator('#idle').waitFor();
    await other.locator('#ended-box summary').click();
    await saying(other, '#ended', 'ABORTED').waitFor();
  },

  // The network is cut while tasks run: when it is back, the page knows what became of them.
  async cut() {
    const links = new Set();
    let isCut = false;
    const proxy = createProxy((browserEnd) => {
      const consoleEnd = connect(new URL(url).port, '127.0.0.1');
      for (const [end, other] of [[browserEnd, consoleEnd], [consoleEnd, browserEnd]]) {
        links.add(end);
        end.on('error', () => {}).on('close', () => { links.delete(end); other.destroy(); });
        end.pipe(other);
      }
      if (isCut) browserEnd.destroy();
    });
    await new Promise((done) => proxy.listen(0, '127.0.0.1', done));
    const cut = () => {
      isCut = true;
      for (const end of links) end.destroy();
    };
    const page = await open(SIZES.phone, `http://127.0.0.1:${proxy.address().port}/`);
    await start(page, 'test/sleep', '60');
    const [, , id] = JSON.parse(await saying(page, '#running', 'test:sleep:60').getAttribute('data-key'));
    await start(page, 'test/mark', 'x');
    await saying(page, '#running', 'test:mark:x').waitFor();
    cut();
    await saying(page, '#goals', 'sleep 60').getByText('UNKNOWN').waitFor();
    await check(page, 'cut');
    // One of them ends meanwhile.
    await outside(`abort ${id}`);
    isCut = false;
    await page.locator('#connection[data-state=open]').waitFor();
    await saying(page, '#goals', 'sleep 60').getByText('ABORTED').waitFor();
    await saying(page, '#goals', 'mark x').getByText('running').waitFor();
    await page.getByText('You operate.').waitFor();
    await saying(page, '#goals', 'mark x').getByText('Abort', { exact: true }).click();
    await saying(page, '#goals', 'mark x').getByText('ABORTED').waitFor();
    proxy.close();
  },

  async encrypted() {
    const page = await open();
    const [cookie] = await browser.cookies();
    assert.deepEqual([page.url().slice(0, 8), cookie.secure], ['https://', true]);
    await start(page, 'test/echo', 'hidden');
    await saying(page, '#goals', 'COMPLETED: hidden').waitFor();
  },

  // The console and the server are killed and return. Nothing starts twice.
  async killed() {
    const page = await open();
    await start(page, 'test/mark', 'x');
    await saying(page, '#running', 'test:mark:x').waitFor();
    await outside('kill the console');
    await page.locator('#connection[data-state=lost]').waitFor();
    await saying(page, '#goals', 'UNKNOWN').waitFor();
    await page.keyboard.press('Escape');
    await page.getByText('NOT SENT: no connection').waitFor();
    await outside('start the console');
    await page.locator('#connection[data-state=open]').waitFor();
    await saying(page, '#running', 'test:mark:x').waitFor();
    assert.equal(await page.locator('#running .card').count(), 1);
    await outside('kill the server');
    // Another robot is missing from the start.
    await page.locator('#robot-list .card[data-key=ours]', { hasText: 'MISSING' }).waitFor();
    await saying(page, '#running', 'the robot is missing: last known').waitFor();
    await outside('start the server');
    await saying(page, '#robot-list', 'there for').waitFor();
    await page.locator('#idle').waitFor();
    await start(page, 'test/echo', 'again');
    await saying(page, '#goals', 'COMPLETED: again').waitFor();
  },

  // A page of another origin reaches nothing, also if its name leads to this machine: DNS rebinding.
  async origin() {
    const server = createServer((_, answer) => answer.setHeader('content-type', 'text/html').end('<title>hostile</title>'));
    await new Promise((done) => server.listen(0, '127.0.0.1', done));
    const page = await browser.newPage();
    await page.goto(`http://127.0.0.1:${server.address().port}/`);
    const connect = (where) => page.evaluate((at) => new Promise((done) => {
      const socket = new WebSocket(at);
      socket.onopen = () => done('open');
      socket.onerror = () => done('refused');
    }), where);
    assert.equal(await connect(`${url.replace('http', 'ws')}rosbridge`), 'refused');
    const fetched = await page.evaluate((where) => fetch(where).then(() => 'read', () => 'refused'), url);
    assert.equal(fetched, 'refused');
    await page.setContent(`<iframe src="${url}"></iframe>`);
    await page.locator('iframe').waitFor();
    assert.equal(await page.frameLocator('iframe').locator('#stop').count(), 0);
    const rebound = new URL(url);
    rebound.hostname = 'hostile.test';
    assert.equal((await page.goto(rebound.href)).status(), 403);
    assert.equal(await connect(`ws://${rebound.host}/rosbridge`), 'refused');
    server.close();
  },

  // A watcher's page shows everything and stops everything. It starts nothing.
  async watcher() {
    const page = await open(SIZES.phone);
    await page.getByText('connected, as a watcher').waitFor();
    assert.equal(page.url(), new URL('/', url).href);
    const [cookie] = await browser.cookies();
    assert.deepEqual([cookie.httpOnly, cookie.sameSite], [true, 'Strict']);
    assert.equal(await page.locator('#start').isVisible(), false);
    await outside('start a task');
    await saying(page, '#running', 'test:sleep:60').waitFor();
    await check(page, 'watcher');
    await saying(page, '#running', 'test:sleep:60').getByText('Abort').click();
    await page.locator('#idle').waitFor();
    await page.keyboard.press('Escape');
    await page.getByText('ours: confirmed: nothing ran').waitFor();
    await page.getByText(/watcher \d+ at 127\.0\.0\.1/).waitFor();
  },
};

try {
  await scenarios[scenario]();
  console.log('passed');
} finally {
  await browser.close();
}
process.exit(0);

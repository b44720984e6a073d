// Drives Chromium for one scenario of tests/web/page.rs: node driver.mjs SCENARIO URL DIRECTORY.
// Prints `do: WHAT` when the test has to do something outside the browser, and waits for a line.

import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { createServer } from 'node:http';
import { createRequire } from 'node:module';
import { createInterface } from 'node:readline';

const [scenario, url, directory] = process.argv.slice(2);
const require = createRequire(`${process.env.ZTL_CLIENTS}/`);
const { chromium } = require('playwright-core');
const axe = readFileSync(require.resolve('axe-core/axe.min.js'), 'utf8');
const SIZES = { phone: [390, 844], tablet: [820, 1180], desk: [1440, 900] };
const LIMIT = 20_000;

const browser = await chromium.launchPersistentContext(`${directory}/profile`, {
  executablePath: '/usr/bin/chromium',
  headless: true,
  args: ['--no-sandbox', '--disable-gpu', '--disable-quic', '--no-first-run', '--disable-background-networking',
    '--disable-component-update', '--disable-sync', '--host-resolver-rules=MAP hostile.test 127.0.0.1'],
});
browser.setDefaultTimeout(LIMIT);
const lines = createInterface({ input: process.stdin })[Symbol.asyncIterator]();

async function outside(what) {
  console.log(`do: ${what}`);
  await lines.next();
}

async function open([width, height] = SIZES.desk) {
  const page = await browser.newPage();
  await page.setViewportSize({ width, height });
  page.alerts = 0;
  page.on('dialog', (dialog) => { page.alerts += 1; dialog.dismiss(); });
  await page.goto(url);
  await page.locator('#connection[data-state=open]').waitFor();
  await page.locator('#component option').first().waitFor({ state: 'attached' });
  return page;
}

// Starts a task of a component that the robot `ours` does not tell, as by free text.
async function start(page, component, goal) {
  const others = page.locator('#component optgroup[label=ours] option', { hasText: 'another of' });
  await page.locator('#component').selectOption(await others.first().getAttribute('value'));
  await page.locator('#other').fill(component);
  await page.locator('#goal').fill(goal);
  await page.locator('#start').click();
}

const saying = (page, list, text) => page.locator(`${list} .card`, { hasText: text });

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
      await saying(page, '#running', 'by operator at 127.0.0.1').waitFor();
      await saying(page, '#robot-list', 'MISSING').waitFor();
      await check(page, name);
      await saying(page, '#running', 'test:sleep:60').getByText('Abort').click();
      await saying(page, '#goals', 'ABORTED').waitFor();
      await page.locator('#idle').waitFor();
      // By keys: a goal with Enter, and Stop with Escape while the text field has the focus.
      await page.locator('#goal').fill('50');
      await page.locator('#goal').press('Enter');
      await saying(page, '#running', 'test:sleep:50').waitFor();
      await page.locator('#goal').press('Escape');
      await page.getByText('ours: confirmed: 1 task has ended').waitFor();
      await page.getByText('gone: NOT CONFIRMED').waitFor();
      await page.getByText('NOT every robot has confirmed').waitFor();
      await saying(page, '#goals', 'sleep 50').getByText('ABORTED').waitFor();
      await check(page, `${name}-stopped`);
      await page.locator('#stopped-close').click();
      await page.close();
    }
  },

  // Text of robots and of goals is shown as it is.
  async hostile() {
    const page = await open();
    const evil = '<img src=x onerror=alert(1)><script>alert(2)</script>"\'&\u202e';
    await start(page, 'test/echo', evil);
    await saying(page, '#goals', `COMPLETED: ${evil}`).waitFor();
    await start(page, 'x/echo', 'W'.repeat(300));
    await page.locator('#ended-box summary').click();
    await saying(page, '#ended', '<img src=x').waitFor();
    assert.equal(await page.locator('main img, main script').count(), 0);
    assert.equal(page.alerts, 0);
    await check(page, 'hostile');
  },

  // Two pages see the same, and a task of anybody can be aborted on each.
  async two() {
    const [one, other] = [await open(), await open(SIZES.phone)];
    await start(one, 'test/sleep', '60');
    await saying(other, '#running', 'test:sleep:60').getByText('Abort').click();
    await saying(one, '#goals', 'ABORTED').waitFor();
    await start(other, 'test/sleep', '61');
    await saying(one, '#running', 'test:sleep:61').waitFor();
    await one.locator('#stop').click();
    await other.getByText('ours: confirmed: 1 task has ended').waitFor();
    await saying(other, '#goals', 'ABORTED').waitFor();
  },

  // A double click and a held Enter start one task each.
  async presses() {
    const page = await open();
    await start(page, 'test/mark', 'x');
    await page.locator('#start').click();
    await page.getByText('not sent again').waitFor();
    await saying(page, '#running', 'test:mark:x').waitFor();
    await page.locator('#goal').fill('y');
    await page.locator('#goal').focus();
    for (let repeat = 0; repeat < 15; repeat += 1) await page.keyboard.down('Enter');
    await page.keyboard.up('Enter');
    await saying(page, '#running', 'test:mark:y').waitFor();
    assert.equal(await page.locator('#goals .card').count(), 2);
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
    await saying(page, '#robot-list', 'MISSING').waitFor();
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

  // A watcher's page shows everything, and its buttons do nothing.
  async watcher() {
    const page = await open(SIZES.phone);
    await page.getByText('connected, as a watcher').waitFor();
    assert.equal(page.url(), new URL('/', url).href);
    const [cookie] = await browser.cookies();
    assert.deepEqual([cookie.httpOnly, cookie.sameSite], [true, 'Strict']);
    assert.ok(await page.locator('#start').isDisabled());
    assert.ok(await page.locator('#stop').isDisabled());
    await check(page, 'watcher');
  },
};

try {
  await scenarios[scenario]();
  console.log('passed');
} finally {
  await browser.close();
}
process.exit(0);

// A picture of a page after so many seconds, in headless Chromium over its own protocol; JPEG or PNG by the file's name. What the
// address names behind a # stands at its upper edge.
//   node pictures.mjs CHROMIUM ADDRESS FILE WIDTHxHEIGHT SECONDS
import { spawn } from 'node:child_process';
import { mkdtempSync, rmSync, writeFileSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join } from 'node:path';

const [chromium, address, file, size, seconds] = process.argv.slice(2);
const [width, height] = size.split('x').map(Number);
const profile = mkdtempSync(join(tmpdir(), 'dgtr-pictures-'));
const browser = spawn(chromium, ['--headless=new', '--no-sandbox', '--disable-gpu', '--hide-scrollbars', '--remote-debugging-pipe', '--no-first-run',
    `--user-data-dir=${profile}`, 'about:blank'], { stdio: ['ignore', 'ignore', 'ignore', 'pipe', 'pipe'] });
const waiting = new Map();
let session, number = 0, pending = '';

browser.stdio[4].on('data', (data) => {
    const parts = (pending + data).split('\0');
    pending = parts.pop();
    for (const { id, result, error } of parts.map((part) => JSON.parse(part))) {
        if (!id) continue;
        const { done, failed } = waiting.get(id);
        if (error) failed(new Error(error.message)); else done(result);
    }
});

function send(method, params = {}) {
    const id = ++number;
    browser.stdio[3].write(`${JSON.stringify({ id, method, params, sessionId: session })}\0`);
    return new Promise((done, failed) => waiting.set(id, { done, failed }));
}

const { targetId } = await send('Target.createTarget', { url: 'about:blank' });
session = (await send('Target.attachToTarget', { targetId, flatten: true })).sessionId;
await send('Page.enable');
await send('Emulation.setDeviceMetricsOverride', { width, height, deviceScaleFactor: 1, mobile: false });
const { errorText } = await send('Page.navigate', { url: address });
if (errorText) throw new Error(`${address}: ${errorText}`);
await new Promise((done) => setTimeout(done, 1000 * Number(seconds)));
await send('Runtime.evaluate', { expression: 'location.hash && document.querySelector(location.hash).scrollIntoView()' });
await new Promise((done) => setTimeout(done, 300));
const format = file.endsWith('.jpg') ? { format: 'jpeg', quality: 79 } : { format: 'png' };
const { data } = await send('Page.captureScreenshot', format);
writeFileSync(file, Buffer.from(data, 'base64'));
browser.kill();
await new Promise((done) => browser.on('exit', done));
rmSync(profile, { recursive: true, force: true, maxRetries: 5 });
process.exit(0);

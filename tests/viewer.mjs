// Opens a page of `dgtr export --to html` (or, by its http:// address, one of `--to streamed`) in headless Chromium as a double click would: file://, no network but this machine's, WebGL 2 in software, no
// WebGPU. Drives it as a person would, with the mouse, and says what it saw as JSON. No packages: the browser's own protocol over a pipe.
//   node viewer.mjs CHROMIUM PAGE.html FOLDER STEPS.json
// Steps: {"camera": N} clicks the picture of camera N; {"click": [x, y]} clicks the scene; {"measure": true} the button;
// {"wheel": N} turns the wheel by N notches (away: positive); {"shot": "NAME"} takes a picture into FOLDER/NAME.png. What the panel says is noted after each step.
import { spawn } from 'node:child_process';
import { mkdtempSync, readFileSync, rmSync, writeFileSync } from 'node:fs';
import { tmpdir } from 'node:os';
import { join, resolve } from 'node:path';
import { pathToFileURL } from 'node:url';

const [chromium, page, folder, steps] = process.argv.slice(2);
const profile = mkdtempSync(join(tmpdir(), 'dgtr-viewer-'));
const browser = spawn(chromium, [
    '--headless=new', '--no-sandbox', '--remote-debugging-pipe', `--user-data-dir=${profile}`, '--window-size=1280,800',
    '--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--disable-features=WebGPU', '--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1',
    '--no-first-run', '--disable-background-networking', '--disable-component-update', 'about:blank'
], { stdio: ['ignore', 'ignore', 'ignore', 'pipe', 'pipe'] });

const waiting = new Map();
const seen = { errors: [], requests: [], notes: [] };
let session, number = 0, pending = '';

function send(method, params = {}) {
    const id = ++number;
    browser.stdio[3].write(`${JSON.stringify({ id, method, params, sessionId: session })}\0`);
    return new Promise((done, failed) => waiting.set(id, { done, failed, method }));
}

function heard({ id, method, params, result, error }) {
    if (id) {
        const { done, failed, method: asked } = waiting.get(id);
        waiting.delete(id);
        return error ? failed(new Error(`${asked}: ${error.message}`)) : done(result);
    }
    if (method === 'Runtime.exceptionThrown') seen.errors.push(params.exceptionDetails.exception?.description ?? params.exceptionDetails.text);
    if (method === 'Runtime.consoleAPICalled' && ['error', 'warning', 'assert'].includes(params.type)) {
        seen.errors.push(params.args.map((a) => a.value ?? a.description).join(' '));
    }
    if (method === 'Log.entryAdded' && params.entry.level === 'error') seen.errors.push(params.entry.text);
    if (method === 'Network.requestWillBeSent') seen.requests.push(params.request.url.slice(0, 80));
}

browser.stdio[4].on('data', (data) => {
    const parts = (pending + data).split('\0');
    pending = parts.pop();
    parts.forEach((part) => heard(JSON.parse(part)));
});

const pause = (ms) => new Promise((done) => setTimeout(done, ms));

async function evaluate(expression) {
    const { result, exceptionDetails } = await send('Runtime.evaluate', { expression, returnByValue: true, awaitPromise: true });
    if (exceptionDetails) throw new Error(exceptionDetails.text);
    return result.value;
}

async function until(expression, seconds) {
    for (const end = Date.now() + 1000 * seconds; Date.now() < end; await pause(100)) {
        if (await evaluate(expression)) return;
    }
    throw new Error(`not within ${seconds} s: ${expression}; ${seen.errors.join('; ')}`);
}

async function click(x, y) {
    const at = { x, y, button: 'left', clickCount: 1 };
    await send('Input.dispatchMouseEvent', { ...at, type: 'mouseMoved', button: 'none' });
    await send('Input.dispatchMouseEvent', { ...at, type: 'mousePressed' });
    await send('Input.dispatchMouseEvent', { ...at, type: 'mouseReleased' });
}

async function clickOn(selector) {
    const box = await evaluate(`(() => { const e = document.querySelector(${JSON.stringify(selector)}); e.scrollIntoView();
        const b = e.getBoundingClientRect(); return [b.x + b.width / 2, b.y + b.height / 2]; })()`);
    await click(...box);
}

async function step(what) {
    const rests = 'Number(document.body.dataset.rest ?? 0)';
    if ('camera' in what) {
        const before = await evaluate(rests);
        await clickOn(`#dgtr-cameras button:nth-child(${what.camera + 1})`);
        await until(`${rests} > ${before}`, 180);
        await pause(500);
    }
    for (let n = 0; n < Math.abs(what.wheel ?? 0); n++) {
        const at = { x: 640, y: 400, deltaX: 0, deltaY: 120 * Math.sign(what.wheel) };
        await send('Input.dispatchMouseEvent', { ...at, type: 'mouseWheel' });
        await pause(100);
    }
    if (what.wheel) await pause(8000); // what is nearer or farther now comes in
    if (what.measure) await clickOn('#dgtr-measure');
    if (what.click) await click(...what.click);
    await pause(300);
    if (what.shot) {
        const { data } = await send('Page.captureScreenshot', { format: 'png' });
        writeFileSync(join(folder, `${what.shot}.png`), Buffer.from(data, 'base64'));
    }
    seen.notes.push(await evaluate(`(() => {
        const tip = (id) => ['x2', 'y2'].map((k) => Number(document.querySelector('#dgtr-' + id + ' line').getAttribute(k)));
        const scale = document.getElementById('dgtr-scale');
        return { measured: document.getElementById('dgtr-measured').textContent, north: tip('north'), east: tip('east'), up: tip('up'),
            scale: scale.hidden ? null : [scale.textContent, scale.getBoundingClientRect().width],
            cameras: document.querySelectorAll('#dgtr-cameras img').length };
    })()`));
}

let code = 0;
try {
    const { targetId } = await send('Target.createTarget', { url: 'about:blank' });
    session = (await send('Target.attachToTarget', { targetId, flatten: true })).sessionId;
    for (const domain of ['Runtime', 'Log', 'Network', 'Page']) await send(`${domain}.enable`);
    await send('Emulation.setDeviceMetricsOverride', { width: 1280, height: 800, deviceScaleFactor: 1, mobile: false });
    const start = Date.now();
    await send('Page.navigate', { url: page.startsWith('http:') ? page : pathToFileURL(resolve(page)).href });
    await until('document.body?.dataset.rest > 0', 180);
    seen.seconds = (Date.now() - start) / 1000;
    seen.webgpu = await evaluate("'gpu' in navigator && navigator.gpu ? (async () => !!(await navigator.gpu.requestAdapter()))() : false");
    for (const what of JSON.parse(readFileSync(steps))) await step(what);
} catch (error) {
    seen.failed = String(error);
    code = 1;
}
console.log(JSON.stringify(seen));
browser.kill();
await new Promise((done) => browser.on('exit', done));
rmSync(profile, { recursive: true, force: true, maxRetries: 5 });
process.exit(code);

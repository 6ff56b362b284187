// What dgtr adds to the viewer: pictures of the cameras to jump to, where north and up are, a scale bar, and measuring. The viewer's
// world is x east, y up, z south in metres; east, north, up is what people read.

const scene = JSON.parse(document.getElementById('dgtr-scene').textContent);
const byId = (id) => document.getElementById(id);
// A scene in levels of detail lies beside the page and comes piece by piece; all others are inside.
const streamed = scene.streamed;
const packed = streamed ? null : Uint8Array.from(atob(byId('dgtr-sog').textContent), (c) => c.charCodeAt(0));
if (streamed && location.protocol === 'file:') {
    document.body.textContent = 'This scene is streamed: open it by HTTP, for instance "python3 -m http.server" in its folder.';
    throw new Error('a streamed scene needs HTTP');
}

const viewer = await createViewer({
    container: byId('dgtr-viewer'),
    settings: scene.settings,
    ...(streamed
        ? { contentUrl: streamed, contentFilename: streamed }
        : { contentUrl: 'scene.sog', contentFilename: 'scene.sog', contents: Promise.resolve(new Response(packed)) }),
    renderer: 'webgl', // every laptop has it, and nothing differs between machines
    noanim: true
});
// The viewer takes files to be y down and turns them by half; ours are east, north, up.
const [east, north, up] = scene.shift;
viewer.app.root.on('childinsert', (node) => {
    if (node.name !== 'gsplat') return;
    node.setLocalEulerAngles(-90, 0, 0);
    node.setLocalPosition(east, up, -north);
});
if (!viewer.state.loaded) {
    await new Promise((resolve) => viewer.events.once('loaded:changed', resolve));
}
viewer.state.cameraMode = 'orbit';
viewer.state.showAnnotations = false; // a button per camera, in the air over the scene, hides it
viewer.resetCamera();

const camera = viewer.app.root.findComponent('camera');
const canvas = viewer.app.graphicsDevice.canvas;
const splats = packed && (await unpack(packed));
byId('dgtr-measure').hidden = !splats; // it looks along a ray through all Gaussians

// The camera now: place and axes (right, up, back) in east, north, up; tangents of half the view.
function look() {
    const m = camera.entity.getWorldTransform().data;
    const p = camera.projectionMatrix.data;
    const enu = (i) => [m[i], -m[i + 2], m[i + 1]];
    return { at: enu(12), right: enu(0), up: enu(4), back: enu(8), x: 1 / p[0], y: 1 / p[5] };
}

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

// The place in the scene under a point of the canvas (CSS pixels), east, north, up; null where there is none.
function pick(px, py) {
    const view = look();
    const x = ((2 * px) / canvas.clientWidth - 1) * view.x;
    const y = (1 - (2 * py) / canvas.clientHeight) * view.y;
    const ray = [0, 1, 2].map((k) => x * view.right[k] + y * view.up[k] - view.back[k]);
    const length = Math.hypot(...ray);
    const to = ray.map((v) => v / length);
    const from = view.at.map((v, k) => v - scene.shift[k]);
    // A streamed scene is never here as a whole: the level ground through its middle stands for it.
    const level = -from[2] / to[2] > 0 ? -from[2] / to[2] : null;
    const distance = splats ? halfLight(splats, from, to) : level;
    return distance === null ? null : view.at.map((v, k) => v + distance * to[k]);
}

// Where a place is on the canvas; null behind the camera.
function project(view, place) {
    const d = place.map((v, k) => v - view.at[k]);
    const depth = -dot(d, view.back);
    if (depth <= 0) return null;
    const x = (1 + dot(d, view.right) / depth / view.x) / 2;
    const y = (1 - dot(d, view.up) / depth / view.y) / 2;
    return [x * canvas.clientWidth, y * canvas.clientHeight];
}

// Cameras.
const strip = byId('dgtr-cameras');
scene.pictures.forEach((picture, i) => {
    const button = document.createElement('button');
    button.title = scene.settings.annotations[i].title;
    button.append(Object.assign(new Image(), { src: picture, alt: button.title }));
    button.addEventListener('click', () => viewer.selectAnnotation(i));
    strip.append(button);
});

// Measuring.
let measuring = false;
let points = [];
const metres = (v) => `${v.toFixed(2)} m`;

function report() {
    const rows = points.map((p, i) => `${'AB'[i]}: ${metres(p[0])} E, ${metres(p[1])} N, ${metres(p[2])} up`);
    if (points.length === 2) {
        const d = [0, 1, 2].map((k) => points[1][k] - points[0][k]);
        rows.push(`Distance ${metres(Math.hypot(...d))}`);
        rows.push(`Level ${metres(Math.hypot(d[0], d[1]))}`);
        rows.push(`Height ${d[2] < 0 ? '−' : '+'}${metres(Math.abs(d[2]))}`);
    }
    if (rows.length === 0 && measuring) rows.push('Click two places of the scene');
    byId('dgtr-measured').textContent = rows.join('\n');
}

function measure(on) {
    measuring = on;
    points = [];
    byId('dgtr-measure').setAttribute('aria-pressed', String(on));
    report();
}

byId('dgtr-measure').addEventListener('click', () => measure(!measuring));
window.addEventListener('keydown', (event) => event.key === 'Escape' && measuring && measure(false));
let pressed = null;
canvas.addEventListener('pointerdown', (event) => (pressed = [event.offsetX, event.offsetY]));
// For the viewer a click is the wish to turn around that place, or to go there; not while it measures.
const moves = ['pick', 'orbitTarget:set', 'navigateTo'];
const fire = viewer.events.fire.bind(viewer.events);
viewer.events.fire = (name, ...values) => (measuring && moves.includes(name) ? viewer.events : fire(name, ...values));
canvas.addEventListener('click', (event) => {
    // A drag turns the view.
    if (!measuring || !pressed || Math.hypot(event.offsetX - pressed[0], event.offsetY - pressed[1]) >= 4) return;
    const place = pick(event.offsetX, event.offsetY);
    if (place) points = points.length === 2 ? [place] : [...points, place];
    report();
});

// Compass: the world's axes as the camera sees them.
const axes = { east: [1, 0, 0], north: [0, 1, 0], up: [0, 0, 1] };

function drawCompass(view) {
    for (const [name, axis] of Object.entries(axes)) {
        const tip = [38 * dot(axis, view.right), -38 * dot(axis, view.up)];
        const arrow = byId(`dgtr-${name}`);
        arrow.querySelector('line').setAttribute('x2', tip[0]);
        arrow.querySelector('line').setAttribute('y2', tip[1]);
        arrow.querySelector('text').setAttribute('x', 1.2 * tip[0]);
        arrow.querySelector('text').setAttribute('y', 1.2 * tip[1]);
        // Pointing at the reader, its name would lie on the others.
        arrow.querySelector('text').setAttribute('visibility', Math.hypot(...tip) < 10 ? 'hidden' : 'visible');
    }
}

// Scale bar: how long so many pixels are at the middle of the screen.
function drawScale(view) {
    const middle = pick(canvas.clientWidth / 2, canvas.clientHeight / 2);
    byId('dgtr-scale').hidden = middle === null;
    if (middle === null) return;
    const depth = -dot(middle.map((v, k) => v - view.at[k]), view.back);
    const pixel = (2 * depth * view.y) / canvas.clientHeight;
    const power = 10 ** Math.floor(Math.log10(140 * pixel));
    const length = [5, 2, 1].map((f) => f * power).find((l) => l <= 140 * pixel);
    byId('dgtr-scale').style.width = `${length / pixel}px`;
    byId('dgtr-scale').textContent = length < 1 ? `${Math.round(100 * length)} cm` : `${length} m`;
}

function drawPoints(view) {
    const places = points.map((p) => project(view, p));
    const line = byId('dgtr-line');
    line.setAttribute('visibility', places.length === 2 && places[0] && places[1] ? 'visible' : 'hidden');
    ['dgtr-a', 'dgtr-b'].forEach((id, i) => {
        const at = places[i];
        byId(id).setAttribute('visibility', at ? 'visible' : 'hidden');
        if (!at) return;
        byId(id).setAttribute('transform', `translate(${at[0]} ${at[1]})`);
        line.setAttribute(`x${i + 1}`, at[0]);
        line.setAttribute(`y${i + 1}`, at[1]);
    });
}

let before = '';
let still = 0;
function draw() {
    requestAnimationFrame(draw);
    const view = look();
    const now = JSON.stringify([view, canvas.clientWidth, canvas.clientHeight]);
    drawPoints(view);
    if (now !== before) {
        before = now;
        still = performance.now();
        drawCompass(view);
    } else if (still && performance.now() - still > 150) {
        // A ray through all Gaussians takes some milliseconds: once, when the camera has come to rest.
        still = 0;
        drawScale(view);
        document.body.dataset.rest = String(Number(document.body.dataset.rest ?? 0) + 1);
    }
}
draw();
byId('dgtr-panel').hidden = false;
document.body.dataset.ready = 'true';

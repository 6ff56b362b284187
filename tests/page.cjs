// What tests/page.sh has a browser do. Every promise that is broken is one line, and the exit code is 1.
"use strict";
const { chromium } = require("playwright-core");
const axe = require("fs").readFileSync(require.resolve("axe-core/axe.min.js"), "utf8");
const path = require("path");

const [mode, out, ...rest] = process.argv.slice(2);
const broken = [];
const promise = (kept, words) => {
  console.log((kept ? "kept:   " : "BROKEN: ") + words);
  if (!kept) broken.push(words);
};
const sleep = (s) => new Promise((done) => setTimeout(done, 1000 * s));

// A page whose errors and requests are noted.
async function open(browser, url, scheme) {
  const context = await browser.newContext({ colorScheme: scheme, viewport: { width: 1280, height: 1000 } });
  const page = await context.newPage();
  const [errors, asked] = [[], []];
  page.on("console", (m) => m.type() === "error" && errors.push(m.text()));
  page.on("pageerror", (e) => errors.push(e.message));
  page.on("request", (r) => asked.push(r.url()));
  for (let tries = 0; ; tries += 1) {
    try {
      await page.goto(url, { waitUntil: "load" });
      break;
    } catch (e) {
      if (tries > 120) throw e;
      await sleep(0.5);
    }
  }
  errors.length = 0;
  return { page, errors, asked, context };
}

async function accessible(page, name) {
  const found = await page.evaluate(`${axe}; axe.run(document, { runOnly: ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "best-practice"] })`);
  const lines = found.violations.map((v) => `${v.id} at ${v.nodes.map((n) => n.target.join(" ")).slice(0, 3).join("; ")}`);
  promise(lines.length === 0, `${name}: ${found.passes.length} rules of axe pass, ${lines.length} do not ${lines.join(" | ")}`);
}

async function live(browser, port) {
  const ground = await open(browser, `http://127.0.0.1:${port}/`, "light");
  const west = await open(browser, `http://127.0.0.1:${port + 1}/`, "dark");
  const words = (p) => p.page.evaluate(() => document.querySelector("main").innerText);
  const states = { ground: new Set(), west: new Set() };
  const seen = { curve: false, picture: false, footprints: false, squares: false, ortho: false, arrived: false };
  let shots = 0;
  for (let i = 0; i < 600; i += 1) {
    states.ground.add(await words(ground));
    states.west.add(await words(west));
    const now = await west.page.evaluate(() => ({
      status: document.getElementById("status").textContent,
      curve: !!document.querySelector("#aircraft-cards polyline"),
      picture: [...document.querySelectorAll("#aircraft-cards img")].some((i) => i.naturalWidth > 0),
      footprints: document.querySelectorAll("#drawing polygon.foot").length > 0,
      squares: !!document.querySelector('#drawing path.covered[d*="M"], #drawing path.thin[d*="M"]'),
      ortho: !!document.querySelector("#drawing image"),
      training: document.body.innerText.includes("training"),
    }));
    for (const what of ["curve", "picture", "footprints", "squares", "ortho"]) seen[what] ||= now[what];
    const arrived = await ground.page.evaluate(() => document.body.innerText.includes("is here") && !!document.querySelector("#drawing circle"));
    if (shots === 0 && now.curve && now.squares) {
      shots = 1;
      await west.page.screenshot({ path: path.join(out, "west-live-dark.png"), fullPage: true });
      await accessible(west.page, "the aircraft's live page, dark");
      await keyboard(west.page);
    }
    if (arrived && !seen.arrived) {
      seen.arrived = true;
      await ground.page.screenshot({ path: path.join(out, "ground-live-light.png"), fullPage: true });
      await accessible(ground.page, "the ground's live page, light");
    }
    const over = await ground.page.evaluate(() => /ended|lost/.test(document.getElementById("status").textContent));
    if (over) break;
    await sleep(0.5);
  }
  promise(states.west.size > 5, `the aircraft's page changed ${states.west.size} times`);
  promise(states.ground.size > 3, `the ground's page changed ${states.ground.size} times`);
  for (const [what, was] of Object.entries(seen)) promise(was, `seen while the demo ran: ${what}`);
  // A browser says so when the job at the other end has gone: that is none of the page's.
  const own = (p) => p.errors.filter((e) => !/ERR_CONNECTION_REFUSED|ERR_INCOMPLETE_CHUNKED|ERR_CONNECTION_RESET|ERR_EMPTY_RESPONSE/.test(e));
  promise(own(west).length === 0 && own(ground).length === 0, `no console errors ${own(west).concat(own(ground)).join(" | ")}`);
  const elsewhere = west.asked.concat(ground.asked).filter((u) => !u.startsWith("http://127.0.0.1:") && !u.startsWith("data:"));
  promise(elsewhere.length === 0, `nothing is fetched from elsewhere ${elsewhere.join(" ")}`);
}

// With the keyboard alone: past the header to the layers of the map, one of which is switched off and on.
async function keyboard(page) {
  await page.evaluate(() => document.activeElement?.blur());
  await page.keyboard.press("Tab");
  promise(await page.evaluate(() => document.activeElement.classList.contains("skip")), "the first stop of the keyboard skips to the content");
  for (let i = 0; i < 30 && !(await page.evaluate(() => document.activeElement.id === "show-foot")); i += 1) {
    await page.keyboard.press("Tab");
  }
  const drawn = () => page.evaluate(() => document.querySelectorAll("#drawing polygon.foot").length);
  const before = await drawn();
  await page.keyboard.press("Space");
  const off = await drawn();
  await page.keyboard.press("Space");
  promise(before > 0 && off === 0 && (await drawn()) > 0, `footprints are switched with the keyboard (${before}, ${off})`);
}

async function frozen(browser, files) {
  for (const [i, file] of files.entries()) {
    for (const scheme of ["light", "dark"]) {
      const name = `${path.basename(path.dirname(path.dirname(file)))}-${i}`;
      const { page, errors, asked } = await open(browser, "file://" + file, scheme);
      await sleep(0.3);
      const other = asked.filter((u) => u !== "file://" + file && !u.startsWith("data:"));
      promise(other.length === 0 && errors.length === 0, `${file}: no requests, no errors ${other.concat(errors).join(" ")}`);
      const broken = await page.evaluate(() => [...document.images].filter((i) => i.naturalWidth === 0).length);
      const parts = await page.evaluate(() => [...document.querySelectorAll("section")].filter((s) => !s.hidden).map((s) => s.id));
      promise(broken === 0 && parts.length > 2, `${file}: ${parts.join(", ")}; ${broken} broken pictures`);
      await page.screenshot({ path: path.join(out, `report-${name}-${scheme}.png`), fullPage: true });
      await accessible(page, `${file}, ${scheme}`);
    }
  }
}

(async () => {
  const browser = await chromium.launch({ executablePath: process.env.CHROMIUM, args: ["--no-sandbox", "--disable-gpu"] });
  try {
    await (mode === "live" ? live(browser, Number(rest[0])) : frozen(browser, rest));
  } finally {
    await browser.close();
  }
  process.exit(broken.length ? 1 : 0);
})();

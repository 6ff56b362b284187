// Draws the state of a job. A report carries it; the live page hears of it. No text becomes markup: everything goes through
// textContent and attributes.
"use strict";
(() => {
  const byId = (id) => document.getElementById(id);
  // The parser gave the empty drawing its namespace, so that its address need not stand here.
  const SVG = byId("drawing").namespaceURI;
  // As many colours as the style has; beyond them they repeat. The last is nobody's in particular.
  const COLOURS = 6;

  function fill(element, attributes, children) {
    for (const [name, value] of Object.entries(attributes || {})) {
      if (value !== undefined && value !== null) element.setAttribute(name, value);
    }
    element.append(...[children ?? []].flat().filter((c) => c !== null && c !== undefined));
    return element;
  }
  const html = (tag, attributes, children) => fill(document.createElement(tag), attributes, children);
  const svg = (tag, attributes, children) => fill(document.createElementNS(SVG, tag), attributes, children);

  // A part of the page is drawn anew only when what it shows has changed, and keeps the focus.
  const drawn = new Map();
  function part(section, body, data, isEmpty, draw) {
    const key = JSON.stringify(data);
    if (drawn.get(section) === key) return false;
    drawn.set(section, key);
    byId(section).hidden = isEmpty;
    const focus = document.activeElement && byId(body).contains(document.activeElement) ? document.activeElement.id : "";
    if (!isEmpty) byId(body).replaceChildren(...draw());
    else if (section !== "map") byId(body).replaceChildren();
    if (focus && byId(focus)) byId(focus).focus();
    return true;
  }

  function names(state) {
    const all = state.aircraft.map((a) => a.name).concat(state.regions.map((r) => r.name));
    return [...new Set(all)];
  }
  function colour(state, name) {
    const at = names(state).indexOf(name);
    return "k" + (at < 0 ? COLOURS : at % COLOURS);
  }

  function table(state, id, label, head, rows) {
    const cell = (text, i) => (i === 0 && rows.length > 1 ? html("th", { scope: "row" }, dot(text)) : html("td", {}, text));
    const dot = (text) => (names(state).includes(text) ? [html("span", { class: "dot " + colour(state, text) }), text] : text);
    const body = rows.map((row) => html("tr", { class: row[0] === "global" ? "total" : null }, row.map(cell)));
    const top = head.map((h) => (h === "" ? html("td", {}) : html("th", { scope: "col" }, h)));
    const whole = html("table", {}, [html("thead", {}, html("tr", {}, top)), html("tbody", {}, body)]);
    // It may be wider than the screen: then it is moved with the keyboard, too.
    return html("div", { class: "card", tabindex: "0", role: "region", "aria-label": "table: " + label, id }, whole);
  }

  function curve(craft) {
    const points = craft.curve;
    if (points.length < 2) return null;
    const [xs, ys] = [points.map((p) => p[0]), points.map((p) => p[1])];
    const [x0, x1] = [Math.min(...xs), Math.max(...xs)];
    const [y0, y1] = [Math.min(...ys), Math.max(...ys)];
    const [w, h] = [360, 130];
    const u = (x) => 6 + ((x - x0) / (x1 - x0 || 1)) * (w - 12);
    const v = (y) => h - 22 - ((y - y0) / (y1 - y0 || 1)) * (h - 44);
    const line = points.map((p) => u(p[0]).toFixed(1) + "," + v(p[1]).toFixed(1)).join(" ");
    const [x, y] = craft.axes;
    const round = (n) => Number(n.toPrecision(3));
    const words = `${y} from ${round(ys[0])} to ${round(ys[ys.length - 1])}, ${x} ${Math.round(x0)} to ${Math.round(x1)}`;
    return svg("svg", { viewBox: `0 0 ${w} ${h}`, role: "img", "aria-label": "training curve: " + words }, [
      svg("path", { d: `M6 ${h - 20}H${w - 6}` }),
      svg("polyline", { points: line }),
      svg("text", { x: 6, y: 12 }, `${y}, at most ${round(y1)}`),
      svg("text", { x: 6, y: h - 5 }, `${x} ${Math.round(x0)}`),
      svg("text", { x: w - 6, y: h - 5, "text-anchor": "end" }, `${Math.round(x1)}; ${y} ${round(ys[ys.length - 1])}`),
    ]);
  }

  function card(state, craft, i) {
    const facts = craft.facts.map(([label, value]) => [html("dt", {}, label), html("dd", {}, value)]).flat();
    const source = typeof craft.thumbnail === "number" ? `thumbnail?of=${i}&serial=${craft.thumbnail}` : craft.thumbnail;
    const picture = source ? html("img", { src: source, alt: "last key frame of " + craft.name }) : null;
    const part = craft.progress;
    const progress = part === null ? null
      : html("progress", { max: 1, value: part, "aria-label": `schedule of ${craft.name}` }, `${Math.round(part * 100)} %`);
    return html("article", { class: "craft card " + colour(state, craft.name), "aria-labelledby": "craft-" + i }, [
      html("h3", { id: "craft-" + i }, [html("span", { class: "dot" }), craft.name]),
      html("p", { class: "state" }, craft.state),
      craft.trouble ? html("p", { class: "trouble" }, craft.trouble) : null,
      html("div", { class: "both" }, [html("dl", {}, facts), picture]),
      progress,
      curve(craft),
    ]);
  }

  function map(state, ground) {
    const craft = state.aircraft.filter((a) => a.at && a.at.every(Number.isFinite));
    const of = (i) => names(state)[i] ?? "";
    const shown = (layer) => byId("show-" + layer).checked;
    const here = ground.shots.map((s) => s.at).concat(
      state.regions.flatMap((r) => r.corners.concat(r.cameras)),
      craft.map((a) => a.at),
      ground.ortho ? ground.ortho.corners : [],
    );
    if (here.length === 0) return null;
    const range = (k) => here.reduce(([l, h], p) => [Math.min(l, p[k]), Math.max(h, p[k])], [Infinity, -Infinity]);
    const [x, y] = [range(0), range(1)];
    const [width, margin] = [900, 36];
    const [w, h] = [Math.max(x[1] - x[0], 1e-3), Math.max(y[1] - y[0], 1e-3)];
    const height = Math.min(Math.max(((width - 2 * margin) * h) / w + 2 * margin, 260), 620);
    const scale = Math.min((width - 2 * margin) / w, (height - 2 * margin) / h);
    const u = (p) => width / 2 + (p[0] - 0.5 * (x[0] + x[1])) * scale;
    const v = (p) => height / 2 - (p[1] - 0.5 * (y[0] + y[1])) * scale;
    const corners = (points) => points.map((p) => u(p).toFixed(1) + "," + v(p).toFixed(1)).join(" ");
    const parts = [];
    if (ground.ortho && shown("ortho")) {
      const [nw, ne, sw] = ground.ortho.corners;
      const m = [u(ne) - u(nw), v(ne) - v(nw), u(sw) - u(nw), v(sw) - v(nw), u(nw), v(nw)];
      const place = { href: ground.ortho.src, width: 1, height: 1, preserveAspectRatio: "none" };
      parts.push(svg("image", { ...place, transform: `matrix(${m.map((n) => n.toFixed(3)).join(" ")})` }));
    }
    if (shown("squares")) ground.squares.forEach((s) => parts.push(...squares(s, u, v)));
    if (shown("regions")) {
      state.regions.filter((r) => r.corners.length > 2).forEach((r) => {
        parts.push(svg("polygon", { class: colour(state, r.name), points: corners(r.corners) }));
      });
    }
    if (shown("foot")) {
      ground.shots.filter((s) => s.foot).forEach((s) => {
        parts.push(svg("polygon", { class: "foot " + colour(state, of(s.of)), points: corners(s.foot) }));
      });
    }
    const cameras = state.regions.flatMap((r) => r.cameras.map((at) => [r.name, at]));
    const pictures = cameras.concat(ground.shots.filter((s) => !cameras.some((c) => c[0] === of(s.of))).map((s) => [of(s.of), s.at]));
    if (shown("cameras")) {
      pictures.forEach(([name, at]) => parts.push(svg("circle", { class: colour(state, name), cx: u(at).toFixed(1), cy: v(at).toFixed(1), r: 3 })));
    }
    craft.forEach((a) => parts.push(svg("circle", { class: "craft-at " + colour(state, a.name), cx: u(a.at), cy: v(a.at), r: 7 })));
    // All labels follow all shapes, so that none is painted over.
    state.regions.filter((r) => shown("regions") && r.corners.length).forEach((r) => {
      const [left, top] = [Math.min(...r.corners.map(u)), Math.min(...r.corners.map(v))];
      parts.push(svg("text", { x: left + 8, y: top + 20 }, r.name));
    });
    craft.forEach((a) => parts.push(svg("text", { x: u(a.at) + 11, y: v(a.at) + 5 }, a.name)));
    const metres = roundLength(150 / scale);
    const [base, right] = [height - 12, margin + metres * scale];
    parts.push(svg("path", { d: `M${margin} ${base - 5}V${base}H${right.toFixed(1)}V${base - 5}` }));
    parts.push(svg("text", { class: "scale", x: right + 8, y: base + 2 }, `${metres} m, north is up`));
    const words = [`${state.regions.length} regions`, `${pictures.length} pictures`];
    if (craft.length) words.push(`${craft.length} aircraft`);
    if (ground.ortho) words.push("orthophoto");
    if (ground.squares.length) words.push("coverage: green as wanted, yellow too few pictures or angles, bare in no picture");
    return { parts, height, words };
  }

  // Runs of equal squares become one rectangle each, all of a kind one path.
  function squares(s, u, v) {
    const paths = { 1: "", 2: "" };
    const at = (column, row) => [s.corner[0] + s.side_m * column, s.corner[1] + s.side_m * row];
    for (let i = 0; i < s.states.length; ) {
      const [letter, row] = [s.states[i], Math.floor(i / s.columns)];
      let end = i + 1;
      while (end < (row + 1) * s.columns && s.states[end] === letter) end += 1;
      if (letter in paths) {
        const [low, high] = [at(i - row * s.columns, row), at(end - row * s.columns, row + 1)];
        const [l, r, t, b] = [u(low), u(high), v(high), v(low)].map((n) => n.toFixed(1));
        paths[letter] += `M${l} ${t}H${r}V${b}H${l}Z`;
      }
      i = end;
    }
    return [svg("path", { class: "thin", d: paths[1] }), svg("path", { class: "covered", d: paths[2] })];
  }

  // 1, 2 or 5 times a power of ten, at most what is wanted.
  function roundLength(wanted) {
    const power = 10 ** Math.floor(Math.log10(wanted));
    return Number(([5, 2, 1].map((m) => m * power).find((l) => l <= wanted) ?? power).toPrecision(1));
  }

  let last = null;
  let ground = { shots: [], squares: [], ortho: null };
  function drawMap() {
    const layers = ["ortho", "squares", "foot", "cameras", "regions"].map((l) => byId("show-" + l).checked);
    const places = last.aircraft.map((a) => [a.name, a.at]);
    const made = map(last, ground);
    part("map", "drawing", [last.regions, places, ground, layers], made === null, () => {
      byId("drawing").setAttribute("viewBox", `0 0 900 ${made.height.toFixed(0)}`);
      byId("drawing").setAttribute("aria-label", "map: " + made.words.join(", "));
      byId("map-words").textContent = made.words.join(" · ");
      return made.parts;
    });
  }

  // What a person who does not look should hear: new states, new warnings.
  function say(before, now) {
    const was = (name) => before.aircraft.find((a) => a.name === name) ?? {};
    const lines = now.aircraft.filter((a) => was(a.name).state !== a.state).map((a) => `${a.name}: ${a.state}`);
    lines.push(...now.aircraft.filter((a) => a.trouble && was(a.name).trouble !== a.trouble).map((a) => `${a.name}: ${a.trouble}`));
    lines.push(...now.warnings.filter((w) => !before.warnings.includes(w)));
    if (lines.length) byId("said").replaceChildren(...lines.map((l) => html("p", {}, l)));
  }

  function render(state) {
    if (last) say(last, state);
    last = state;
    document.title = state.title;
    byId("title").textContent = state.title;
    byId("subtitle").textContent = state.subtitle;
    const tile = ([label, value]) => html("div", {}, [html("dt", {}, label), html("dd", {}, value)]);
    part("headline", "headline", state.headline, !state.headline.length, () => state.headline.map(tile));
    const warning = (w) => html("li", {}, w);
    part("warnings", "warnings-list", state.warnings, !state.warnings.length, () => state.warnings.map(warning));
    part("aircraft", "aircraft-cards", state.aircraft, !state.aircraft.length, () => state.aircraft.map((a, i) => card(state, a, i)));
    drawMap();
    const { head, rows } = state.models;
    part("models", "models-body", [state.models, names(state)], !rows.length, () => [table(state, "models-table", "models", head, rows)]);
    part("comparisons", "comparisons-body", state.comparisons, !state.comparisons.length, () => state.comparisons.map(comparison));
    part("timings", "timings-body", [state.timings, names(state)], !state.timings.length, () => state.timings.flatMap((t) => bar(state, t)));
    part("charts", "charts", state.charts, !state.charts.length, () => state.charts.flatMap((c) => [
      html("h2", {}, c.title),
      html("div", { class: "card chart" }, html("img", { src: c.src, alt: c.title })),
    ]));
    part("tables", "tables", state.tables, !state.tables.length, () => state.tables.flatMap((t, i) => [
      html("h2", {}, t.title),
      t.note ? html("p", { class: "note" }, t.note) : null,
      table(state, "table-" + i, t.title, t.head, t.rows),
    ].filter(Boolean)));
    part("skipped", "skipped-body", state.skipped, !state.skipped.length, () => [table(state, "skipped-table", "skipped", ["what", "count"], state.skipped)]);
    const file = ([what, path]) => html("li", {}, [what + ": ", html("code", {}, path)]);
    part("files", "files-list", state.files, !state.files.length, () => state.files.map(file));
  }

  function comparison(c) {
    const panel = (p) => html("div", {}, [
      html("img", { src: p.src, width: p.width, height: p.height, alt: `${c.title}: ${p.label}` }),
      html("small", {}, p.label),
    ]);
    return html("figure", {}, [html("h3", {}, [c.title, html("span", {}, c.note)]), html("div", { class: "panels" }, c.panels.map(panel))]);
  }

  function bar(state, t) {
    const length = html("i", { class: colour(state, t.of) });
    length.style.width = (100 * t.share).toFixed(1) + "%";
    return [html("span", {}, (t.of ? t.of + " · " : "") + t.name), html("span", {}, length), html("b", {}, t.text)];
  }

  document.querySelectorAll(".layers input").forEach((box) => box.addEventListener("change", () => last && drawMap()));
  if (byId("state")) {
    ground = JSON.parse(byId("ground").textContent);
    render(JSON.parse(byId("state").textContent));
    return;
  }

  const status = byId("status");
  status.hidden = false;
  let known = null;
  function tell(words, lost) {
    if (status.textContent !== words) status.textContent = words;
    status.className = lost ? "lost" : "";
  }
  tell("connecting", false);
  const events = new EventSource("events");
  events.onmessage = async (event) => {
    const state = JSON.parse(event.data);
    tell(state.over ? "the job has ended" : "live", state.over);
    render(state);
    if (state.over) events.close();
    if (state.ground === known) return;
    known = state.ground;
    try {
      ground = await (await fetch("ground.json")).json();
      drawMap();
    } catch (e) {
      known = null;
    }
  };
  events.onerror = () => tell("connection lost, trying again; what is shown may be old", true);
})();

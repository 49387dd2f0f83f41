// The page of `undertow show`: one mechanism, live over a web socket or from a recording.
// Everything that moves is a list of frames and a list of decisions (plans); live, they grow; of a
// recording they are all there. What is shown is a function of both and of one time, `shown`.
"use strict";
(() => {
  const $ = (id) => document.getElementById(id);
  const WINDOW = 8;          // seconds on the charts
  const KEPT = 1500;         // frames kept when live
  const TRAIL = 1.2;         // seconds of the tip's path
  const BEHIND = 0.03;       // live pictures are shown so much later, s, so that none is missing; hello may say more
  const STYLES = [["--blue", []], ["--orange", [8, 4]], ["--green", [3, 3]], ["--purple", [10, 3, 2, 3]], ["--red", [6, 2]]];

  let hello = null, frames = [], plans = [], bounds = [], region = null, controls = new Map();
  let state = { mode: "waiting", paused: false, speed: 1, waits: "", why: "" };
  let live = true, watched = false, shown = 0, playing = true, rate = 1;
  let socket = null, retry = 0.4, note = "", noteUntil = 0;
  let camera = { x: 0, y: 0 }, holding = null, drag = null;
  let colours = {}, charts = {}, drawn = 0, fps = 0, counted = performance.now(), listed = "";

  // -- colours, numbers ------------------------------------------------------------------------
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const colour = (name) => (colours[name] ??= getComputedStyle(document.documentElement).getPropertyValue(name).trim());
  dark.addEventListener("change", () => { colours = {}; if (hello) { makeCharts(); makeLegends(); } });
  const short = (v, digits = 3) => (v == null || !isFinite(v) ? "–" : String(Number(v.toPrecision(digits))).replace("-", "−"));
  const clamp = (v, low, high) => Math.min(high, Math.max(low, v));

  // -- frames by time --------------------------------------------------------------------------
  function before(list, t) {  // index of the last item at or before t
    let low = 0, high = list.length - 1;
    while (low < high) { const mid = (low + high + 1) >> 1; if (list[mid].t <= t) low = mid; else high = mid - 1; }
    return low;
  }
  function frameAt(t) {
    if (!frames.length) return null;
    const k = before(frames, t), a = frames[k], b = frames[Math.min(k + 1, frames.length - 1)];
    const part = b.t > a.t ? clamp((t - a.t) / (b.t - a.t), 0, 1) : 0;
    const mix = (p, q) => p.map((v, i) => v + part * (q[i] - v));
    const far = a.x.some((v, i) => i < a.x.length / 2 && Math.abs(b.x[i] - v) > 3);
    return part === 0 || far ? a : { ...a, t, x: mix(a.x, b.x), points: mix(a.points, b.points), held: b.held };
  }
  const turned = (k, i) => k > 0 && Math.abs(frames[k].x[i] - frames[k - 1].x[i]) > 3;  // an angle is counted from the next upright
  function planAt(t) {
    let found = null;
    for (const plan of plans) if (plan.kind === "plan" && plan.t <= t + 1e-6 && (plan.rows || !found)) found = plan;
    return found;
  }
  const latest = () => (frames.length ? frames[frames.length - 1].t : 0);

  // -- what the server says --------------------------------------------------------------------
  function hear(message) {
    switch (message.kind) {
      case "hello": begin(message); break;
      case "frame": {
        const last = frames[frames.length - 1];
        if (last && message.t < last.t) frames = [];
        if (last && message.t === last.t) frames[frames.length - 1] = message; else frames.push(message);
        if (frames.length > KEPT) frames.splice(0, frames.length - KEPT);
        break;
      }
      case "plan": plans.push(message); if (plans.length > 400) plans.shift(); break;
      case "bound": bounds.push(message); if (bounds.length > 20) bounds.shift(); break;
      case "region": region = message; break;
      case "state": state = message; playing = !state.paused; showTransport(); break;
      case "controls": for (const control of message.controls) put(control); break;
      case "reset": frames = []; plans = []; bounds = []; region = null; shown = 0; camera = { x: 0, y: 0 }; break;
      case "note": note = message.text; noteUntil = performance.now() + 6000; break;
    }
  }
  function begin(message) {
    hello = message; frames = message.frames; plans = message.plans; state = message.state;
    live = message.live; watched = !!message.watched; shown = live ? latest() : frames.length ? frames[0].t : 0;
    playing = live ? !state.paused : true;
    document.body.classList.toggle("recorded", !live || watched);
    $("scene").classList.toggle("recorded", !live || watched);
    $("transport").hidden = watched;
    document.title = `${hello.mechanism} – undertow`;
    $("name").textContent = hello.mechanism;
    $("about").textContent = hello.about;
    $("hint").textContent = watched ? "A run, looked at: nothing reaches it from here." : live ? "Drag a part to pull it. Space pauses, R resets." : "Space plays and pauses.";
    $("speed").replaceChildren(...hello.speeds.map((v) => new Option(v === 1 ? "real time" : `1/${Math.round(1 / v)}`, v)));
    $("axis").replaceChildren(...hello.coordinates.map((c, i) => new Option(c.name, i)));
    $("axis").value = hello.coordinates.length - 1;
    $("timebar").hidden = live;
    $("reset").textContent = live ? "Reset" : "To the start";
    if (!live && frames.length) { $("time").min = frames[0].t; $("time").max = latest(); }
    controls = new Map(message.controls.map((one) => [one.name, one]));
    bounds = []; region = null; asked = ""; (message.beside ?? []).forEach(hear);
    makeControls(); makeCharts(); makeLegends(); showTransport();
  }

  // -- connection ------------------------------------------------------------------------------
  const say = (what) => { if (socket && socket.readyState === 1) socket.send(JSON.stringify(what)); };
  function connect() {
    const place = new URL("socket", location.href);
    place.protocol = "ws:";
    socket = new WebSocket(place);
    socket.onopen = () => { retry = 0.4; link("on this machine alone"); };
    socket.onmessage = (event) => hear(JSON.parse(event.data));
    socket.onclose = () => {
      holding = null;
      if (!live) { link("recording"); return; }  // it is all here
      link("connection lost: trying again. Is undertow show still running?", true);
      setTimeout(connect, 1000 * retry);
      retry = Math.min(3, 1.6 * retry);
    };
  }
  function link(words, lost = false) { $("link").textContent = words; $("link").classList.toggle("lost", lost); }

  // -- transport -------------------------------------------------------------------------------
  function showTransport() {
    $("pause").textContent = playing ? "Pause" : "Play";
    $("speed").value = live ? state.speed : rate;
  }
  function pause() {
    if (live) say({ do: "pause", on: !state.paused });
    else { if (!playing && shown >= latest()) shown = frames[0].t; playing = !playing; showTransport(); }
  }
  function step() {
    if (live) say({ do: "step" });
    else { playing = false; shown = Math.min(latest(), shown + rate / 60); showTransport(); }
  }
  function reset() { if (live) say({ do: "reset" }); else { shown = frames[0].t; camera = { x: 0, y: 0 }; } }
  $("pause").onclick = pause; $("step").onclick = step; $("reset").onclick = reset;
  $("left").onclick = () => say({ do: "push", side: -1 });
  $("right").onclick = () => say({ do: "push", side: 1 });
  $("speed").onchange = (e) => { rate = Number(e.target.value); if (live) say({ do: "speed", to: rate }); };
  $("time").oninput = (e) => { shown = Number(e.target.value); playing = false; showTransport(); };
  addEventListener("keydown", (e) => {
    const on = document.activeElement;
    if (watched || e.ctrlKey || e.altKey || e.metaKey || (on && ["INPUT", "SELECT"].includes(on.tagName))) return;
    const speeds = hello ? hello.speeds : [];
    const acts = {
      " ": pause, s: step, ".": step, r: reset,
      ArrowLeft: () => say({ do: "push", side: -1 }), ArrowRight: () => say({ do: "push", side: 1 }),
    };
    const key = e.key.length === 1 ? e.key.toLowerCase() : e.key;
    if (key === " " && on && ["BUTTON", "SUMMARY"].includes(on.tagName)) return;  // presses that
    if (acts[key]) { acts[key](); e.preventDefault(); }
    if (Number(key) >= 1 && Number(key) <= speeds.length) {
      rate = speeds[Number(key) - 1];
      if (live) say({ do: "speed", to: rate }); else showTransport();
    }
  });

  // -- controls --------------------------------------------------------------------------------
  const GROUPS = [["controller", "Controller"], ["plant", "True plant"], ["hand", ""]];
  function makeControls() {
    const box = $("controls");
    box.replaceChildren();
    for (const [group, title] of GROUPS) {
      const own = [...controls.values()].filter((one) => one.group === group);
      if (!own.length) continue;
      if (title) { const head = document.createElement("h2"); head.textContent = title; box.append(head); }
      own.filter((one) => one.main).forEach((one) => box.append(makeControl(one)));
      const folded = own.filter((one) => !one.main);
      if (folded.length) {
        const details = document.createElement("details"), summary = document.createElement("summary"), inner = document.createElement("div");
        summary.textContent = `${folded.length} more parameters of the plant`;
        folded.forEach((one) => inner.append(makeControl(one)));
        details.append(summary, inner); box.append(details);
      }
    }
    if (controls.size) {
      const usual = document.createElement("button");
      usual.textContent = "All as usual"; usual.id = "defaults";
      usual.onclick = () => say({ do: "defaults" });
      box.append(usual);
    }
  }
  function makeControl(one) {
    const label = document.createElement("label"), words = document.createElement("span"), out = document.createElement("output");
    label.className = "control"; label.dataset.name = one.name; words.textContent = one.label;
    let input;
    if (one.choices.length) {
      input = document.createElement("select");
      input.replaceChildren(...one.choices.map((word) => new Option(word, word)));
      input.onchange = () => say({ do: "set", name: one.name, value: input.value });
    } else {
      input = document.createElement("input");
      Object.assign(input, { type: "range", min: one.low, max: one.high, step: "any" });
      let due = 0, waits = 0;
      input.oninput = () => {
        const low = one.low, high = one.high;
        out.textContent = `${short(Number(input.value))} ${one.unit}`;
        clearTimeout(waits);
        const send = () => { due = performance.now() + 60; say({ do: "set", name: one.name, value: clamp(Number(input.value), low, high) }); };
        if (performance.now() >= due) send(); else waits = setTimeout(send, 60);
      };
      input.ondblclick = () => say({ do: "set", name: one.name, value: one.usual });
    }
    label.append(words, out, input);
    fill(label, one);
    return label;
  }
  function fill(label, one) {
    const input = label.querySelector("input, select"), out = label.querySelector("output");
    if (document.activeElement !== input || one.choices.length || !input.matches(":active")) input.value = one.value;
    const believed = one.group === "plant" ? learnt[one.name.slice("plant ".length)] : null;
    const more = believed != null ? `, believed ${short(believed)}` : "";
    out.textContent = one.choices.length ? "" : `${short(one.value)} ${one.unit}${more}`;
    label.classList.toggle("changed", one.value !== one.usual);
  }
  function put(one) {
    controls.set(one.name, one);
    const label = document.querySelector(`.control[data-name="${CSS.escape(one.name)}"]`);
    if (label) fill(label, one);
  }

  // -- the mechanism ---------------------------------------------------------------------------
  function fit(canvas) {
    const ratio = window.devicePixelRatio || 1, box = canvas.getBoundingClientRect();
    const w = Math.round(box.width * ratio), h = Math.round(box.height * ratio);
    if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
    const c = canvas.getContext("2d");
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.clearRect(0, 0, box.width, box.height);
    return [c, box.width, box.height];
  }
  function mapping(w, h) {
    const [left, right, bottom, top] = hello.window, room = 58;  // the words at the top
    const scale = Math.min((w - 20) / (right - left), (h - room - 12) / (top - bottom));
    const ox = w / 2 - scale * ((left + right) / 2 + camera.x), oy = room + (h - room) / 2 + scale * ((top + bottom) / 2 + camera.y);
    return { scale, x: (v) => ox + scale * v, y: (v) => oy - scale * v, back: (px, py) => [(px - ox) / scale, (oy - py) / scale] };
  }
  function follow(points) {  // what drives away is kept in the picture
    const [left, right, bottom, top] = hello.window, tip = [points[2 * hello.count - 2], points[2 * hello.count - 1]];
    const aim = (v, low, high, now) => clamp(now, v - high + 0.1 * (high - low), v - low - 0.1 * (high - low));
    camera.x += 0.2 * (aim(tip[0], left, right, camera.x) - camera.x);
    camera.y += 0.2 * (aim(tip[1], bottom, top, camera.y) - camera.y);
  }
  function drawFigure(c, m, points, w, ghost) {
    const at = (k) => [m.x(points[2 * k]), m.y(points[2 * k + 1])], size = clamp(m.scale * 0.02 + 4, 5, 11);
    c.lineCap = c.lineJoin = "round";
    for (const part of hello.parts) {
      if (ghost && ["ground", "frame", "label"].includes(part.kind)) continue;
      const [x, y] = at(part.at);
      c.strokeStyle = colour("--soft"); c.lineWidth = 2; c.setLineDash([]);
      if (part.kind === "ground") { drawGround(c, m, y, w); }
      else if (part.kind === "label") { c.fillStyle = colour("--ink"); c.font = "15px system-ui, sans-serif"; c.textAlign = "center"; c.fillText(part.text, x, y + 14); }
      else if (part.kind === "box") {
        const bw = Math.max(part.width * m.scale, 4), bh = Math.max(part.height * m.scale, 3);
        c.fillStyle = colour("--fill"); c.strokeStyle = colour("--ink"); c.lineWidth = 1.5;
        c.beginPath(); c.rect(x - bw, y - bh, 2 * bw, 2 * bh); c.fill(); c.stroke();
      } else if (part.kind === "disc") {
        const angle = points[2 * hello.count + part.more], r = Math.max(points[2 * hello.count + part.more + 1] * m.scale, 3);
        c.fillStyle = colour("--wheel"); c.strokeStyle = colour("--ink"); c.lineWidth = 1.5;
        c.beginPath(); c.arc(x, y, r, 0, 7); c.fill(); c.stroke();
        if (part.spoke) { c.beginPath(); c.moveTo(x, y); c.lineTo(x + r * Math.sin(angle), y - r * Math.cos(angle)); c.stroke(); }
      } else {
        const link = part.kind === "link";
        c.strokeStyle = colour(link ? "--blue" : part.kind === "rope" ? "--ink" : "--soft");
        c.lineWidth = link ? size : part.kind === "rope" ? 1.5 : 3;
        c.beginPath();
        for (let k = 0; k < part.count; k++) { const [px, py] = at(part.at + k); k ? c.lineTo(px, py) : c.moveTo(px, py); }
        c.stroke();
        if (link && !ghost) { c.fillStyle = colour("--ink"); c.beginPath(); c.arc(x, y, 0.55 * size, 0, 7); c.fill(); }
      }
    }
  }
  function drawGround(c, m, y, w) {  // with a tick for every step, so that what travels is seen to
    const gap = nice(60 / m.scale), first = Math.ceil(m.back(0, 0)[0] / gap);
    c.beginPath(); c.moveTo(0, y); c.lineTo(w, y); c.stroke();
    c.lineWidth = 1; c.beginPath();
    for (let k = first; m.x(k * gap) < w; k++) { const x = m.x(k * gap); c.moveTo(x, y); c.lineTo(x, y + (k === 0 ? 12 : 5)); }
    c.stroke();
    c.fillStyle = colour("--soft"); c.font = "11px system-ui, sans-serif"; c.textAlign = "center";
    c.fillText("0", m.x(0), y + 24); c.fillText(`${short(gap)} m`, m.x(gap), y + 18);
  }
  function drawScene(frame, plan) {
    const [c, w, h] = fit($("scene"));
    if (!frame) return;
    follow(frame.points);
    const m = mapping(w, h);
    if (plan && plan.ghost) { c.globalAlpha = 0.16; drawFigure(c, m, plan.ghost, w, true); c.globalAlpha = 1; }
    const last = before(frames, shown), tip = 2 * hello.count - 2;
    c.strokeStyle = colour("--orange"); c.lineWidth = 2; c.setLineDash([]);
    for (let k = last; k > 0 && frames[k].t > shown - TRAIL; k--) {
      c.globalAlpha = clamp(1 - (shown - frames[k].t) / TRAIL, 0, 1);
      c.beginPath();
      c.moveTo(m.x(frames[k].points[tip]), m.y(frames[k].points[tip + 1]));
      c.lineTo(m.x(frames[k - 1].points[tip]), m.y(frames[k - 1].points[tip + 1]));
      c.stroke();
    }
    c.globalAlpha = 1;
    drawFigure(c, m, frame.points, w, false);
    for (const [x, y, tx, ty] of frame.held || []) {  // hands and what they hold
      c.strokeStyle = c.fillStyle = colour("--red"); c.lineWidth = 2; c.setLineDash([5, 4]);
      c.beginPath(); c.moveTo(m.x(x), m.y(y)); c.lineTo(m.x(tx), m.y(ty)); c.stroke();
      c.setLineDash([]);
      c.beginPath(); c.arc(m.x(x), m.y(y), 6, 0, 7); c.fill();
      c.beginPath(); c.arc(m.x(tx), m.y(ty), 10, 0, 7); c.stroke();
    }
  }
  const place = (e) => {
    const box = $("scene").getBoundingClientRect();
    return mapping(box.width, box.height).back(e.clientX - box.left, e.clientY - box.top);
  };
  $("scene").addEventListener("pointerdown", (e) => {
    if (!live || watched || !hello || e.button) return;
    $("scene").setPointerCapture(e.pointerId); $("scene").focus({ preventScroll: true });
    holding = e.pointerId; $("scene").classList.add("holding");
    say({ do: "grab", at: place(e) });
    e.preventDefault();
  });
  $("scene").addEventListener("pointermove", (e) => { if (holding === e.pointerId) drag = place(e); });
  const release = (e) => {
    if (holding !== e.pointerId) return;
    holding = drag = null; $("scene").classList.remove("holding"); say({ do: "release" });
  };
  for (const kind of ["pointerup", "pointercancel", "lostpointercapture"]) $("scene").addEventListener(kind, release);

  // -- what comes home -------------------------------------------------------------------------
  let asked = "", askedAt = 0;
  function ask(axis, mx, my) {  // which plane is looked at: the server maps it when it can
    if (!live || watched) return;
    const key = `${axis} ${Math.round(8 * Math.log(mx))} ${Math.round(8 * Math.log(my))}`, now = performance.now();
    if (key === asked || now < askedAt + 300 || socket?.readyState !== 1) return;
    asked = key; askedAt = now;
    say({ do: "look", axis, reach: [mx, my] });
  }
  const cellsOf = () => (region && region.axis === Number($("axis").value) && region.t <= shown + 1 ? region : null);
  function drawRegion(c, px, py) {  // every cell was simulated to its end, with the input's limits
    const map = cellsOf();
    if (!map) return;
    const [far, fast] = map.reach, side = map.side, w = (2 * far) / side, h = (2 * fast) / side;
    const gap = 5;
    c.save(); c.fillStyle = colour("--blue");
    c.beginPath();
    for (let k = 0; k < side * side; k++) {
      const [left, right, low, up] = [px(-far + w * (k % side)), px(-far + w * (k % side + 1)), py(-fast + h * Math.floor(k / side)), py(-fast + h * (Math.floor(k / side) + 1))].map(Math.round);
      if (map.cells[k] === "0") { c.rect(left, up, right - left, low - up); continue; }
      c.globalAlpha = map.cells[k] === "2" ? 0.34 : 0.14;
      c.fillRect(left, up, right - left, low - up);
    }
    c.clip(); c.globalAlpha = 0.35; c.strokeStyle = colour("--soft"); c.lineWidth = 1; c.setLineDash([]);  // lost: hatched
    c.beginPath();
    const width = c.canvas.clientWidth, height = c.canvas.clientHeight;
    for (let d = -height; d < width; d += gap) { c.moveTo(d, height); c.lineTo(d + height, 0); }
    c.stroke(); c.restore();
  }
  // A proved set {|W x| ≤ 1}: whether a state is inside, and where the plane through it cuts the set.
  const within = (rows, x) => Math.hypot(...rows.map((row) => row.reduce((sum, v, k) => sum + v * x[k], 0))) < 1;
  function drawProved(c, px, py, frame, goal, i, n) {
    const rows = region?.proved ?? [];
    if (!rows.length) return;
    const x = frame.x.map((v, k) => v - (k < n ? goal[k] || 0 : 0));
    let aa = 0, ab = 0, bb = 0, ar = 0, br = 0, rr = 0;  // |a z1 + b z2 + r|²
    for (const row of rows) {
      const a = row[i], b = row[n + i];
      let r = 0;
      for (let k = 0; k < 2 * n; k++) if (k !== i && k !== n + i) r += row[k] * x[k];
      aa += a * a; ab += a * b; bb += b * b; ar += a * r; br += b * r; rr += r * r;
    }
    const det = aa * bb - ab * ab, z1 = (ab * br - bb * ar) / det, z2 = (ab * ar - aa * br) / det;
    const room = 1 - (rr + ar * z1 + br * z2);
    if (!(room > 0)) return;
    c.strokeStyle = colour("--green"); c.lineWidth = 2; c.setLineDash([]); c.beginPath();
    const l = Math.sqrt(aa), m = ab / l, q = Math.sqrt(det / aa), size = Math.sqrt(room);  // Cholesky's factor
    for (let k = 0; k <= 60; k++) {
      const p1 = size * Math.cos((k * Math.PI) / 30), p2 = size * Math.sin((k * Math.PI) / 30), v = p2 / q, u = (p1 - m * v) / l;
      const sx = px(z1 + u + (goal[i] || 0)), sy = py(z2 + v);
      k ? c.lineTo(sx, sy) : c.moveTo(sx, sy);
    }
    c.stroke();
  }
  let keyed = "";
  function wordRegion(frame, plan) {
    let words = "";
    if (live && !watched) {
      const map = cellsOf(), n = hello.coordinates.length, goal = plan?.goal ?? [];
      const x = frame.x.map((v, k) => v - (k < n ? goal[k] || 0 : 0));
      words = !map ? "wait" : map.proved.length ? (within(map.proved, x) ? "in" : "out") : "none";
    }
    if (words === keyed) return;
    keyed = words;
    const box = $("region");
    box.replaceChildren();
    if (!words) return;
    if (words === "wait") { box.textContent = "What comes home from here is being mapped."; return; }
    for (const [style, text] of [["home", "comes home, "], ["limited", "with the input at its limit, "], ["lost", "lost. "]]) {
      const mark = document.createElement("i");
      mark.className = style;
      box.append(mark, text);
    }
    const proved = document.createElement("b");
    proved.textContent = { in: "In the proved set.", out: "Not in the proved set (green).", none: "No set is proved." }[words];
    box.append(proved);
  }

  // -- phase plane -----------------------------------------------------------------------------
  function drawPhase(frame, plan) {
    const [c, w, h] = fit($("phase"));
    if (!frame || !hello) return;
    const i = Number($("axis").value), n = hello.coordinates.length, own = hello.coordinates[i], f = own.factor;
    const from = before(frames, shown - WINDOW), to = before(frames, shown);
    let mx = 0, my = 0;
    for (let k = from; k <= to; k++) { mx = Math.max(mx, Math.abs(frames[k].x[i])); my = Math.max(my, Math.abs(frames[k].x[n + i])); }
    const floor = own.unit === "°" ? 0.1 : 0.04;
    mx = 1.15 * Math.max(mx, floor); my = 1.15 * Math.max(my, 4 * floor);
    drawPhase.mx = Math.max(mx, 0.97 * (drawPhase.mx || mx)); drawPhase.my = Math.max(my, 0.97 * (drawPhase.my || my));
    mx = drawPhase.mx; my = drawPhase.my;
    const px = (v) => w / 2 + (v / mx) * (w / 2 - 6), py = (v) => h / 2 - (v / my) * (h / 2 - 6);
    ask(i, mx, my);
    drawRegion(c, px, py);
    c.strokeStyle = colour("--grid"); c.lineWidth = 1; c.setLineDash([]);
    c.beginPath(); c.moveTo(0, py(0)); c.lineTo(w, py(0)); c.moveTo(px(0), 0); c.lineTo(px(0), h); c.stroke();
    const written = (words, x, y, side, style) => {  // readable on a hatched ground, too
      c.font = "12px system-ui, sans-serif"; c.textAlign = side; c.lineJoin = "round"; c.setLineDash([]);
      c.strokeStyle = colour("--panel"); c.lineWidth = 4; c.strokeText(words, x, y);
      c.fillStyle = colour(style); c.fillText(words, x, y);
    };
    const s0 = (p, alpha, dash) => {
      if (!p || !p.rows) return;
      const goal = p.goal || [];
      for (const row of p.rows) {
        const a = row[n + i], b = row[i];
        if (Math.abs(a) + Math.abs(b) < 1e-9) continue;
        let rest = 0;  // what all other states add to s
        for (let k = 0; k < 2 * n; k++) if (k !== i && k !== n + i) rest += row[k] * (frame.x[k] - (k < n ? goal[k] || 0 : 0));
        rest -= b * (goal[i] || 0);
        c.globalAlpha = alpha; c.strokeStyle = colour("--red"); c.lineWidth = 2.5; c.setLineDash(dash);
        c.beginPath();
        if (Math.abs(a) * my > 1e-3 * Math.abs(b) * mx) { c.moveTo(px(-mx), py((b * mx - rest) / a)); c.lineTo(px(mx), py((-b * mx - rest) / a)); }
        else { c.moveTo(px(-rest / b), 0); c.lineTo(px(-rest / b), h); }
        c.stroke();
      }
      c.globalAlpha = 1; c.setLineDash([]);
    };
    if (plan) {  // the surface before fades for half a second
      const k = plans.indexOf(plan);
      let old = null;
      for (let j = k - 1; j >= 0 && !old; j--) if (plans[j].rows) old = plans[j];
      const age = shown - plan.t;
      if (old && age < 0.5) s0(old, 0.5 * (1 - age / 0.5), [4, 4]);
      s0(plan, 1, []);
    }
    if (live && !watched) drawProved(c, px, py, frame, plan?.goal ?? [], i, n);
    wordRegion(frame, plan);
    c.strokeStyle = colour("--blue"); c.lineWidth = 1.8; c.lineJoin = "round"; c.beginPath();
    for (let k = from; k <= to; k++) { const x = px(frames[k].x[i]), y = py(frames[k].x[n + i]); k > from && !turned(k, i) ? c.lineTo(x, y) : c.moveTo(x, y); }
    c.stroke();
    c.fillStyle = colour("--blue"); c.beginPath(); c.arc(px(frame.x[i]), py(frame.x[n + i]), 5, 0, 7); c.fill();
    written("s = 0", 6, h - 7, "left", "--red");
    written(`→ ${own.name}, ±${short(mx * f, 2)} ${own.unit}`, w - 6, h - 7, "right", "--soft");
    written(`↑ its rate, ±${short(my * f, 2)} ${own.unit}/s`, 6, 15, "left", "--soft");
  }

  // -- charts ----------------------------------------------------------------------------------
  const nice = (v) => { const p = 10 ** Math.floor(Math.log10(v)); return (v >= 5 * p ? 5 : v >= 2 * p ? 2 : 1) * p; };
  const threes = (u, k, low, high) => { const one = nice(0.85 * Math.max(high, 1e-9)); return [-one, 0, one]; };
  const tens = (low, high) => { const all = []; for (let e = Math.ceil(Math.log10(low) - 1e-9); e <= Math.log10(high) + 1e-9; e++) all.push(10 ** e); return all; };
  const axisOf = (scale, unit, side, splits = threes) => ({
    scale, side, splits, filter: (u, all) => all, size: 46, gap: 3, font: "11px system-ui, sans-serif", stroke: () => colour("--soft"),
    grid: { stroke: () => colour("--grid"), width: 1, show: side === 3 }, ticks: { show: false }, space: 26,
    values: (u, splits) => splits.map((v) => (v == null ? "" : `${short(v)}${unit.length < 3 ? " " + unit : ""}`.trim())),
  });
  const line = (k, scale, more = {}) => ({
    scale, width: 2, stroke: () => colour(STYLES[k % STYLES.length][0]), dash: STYLES[k % STYLES.length][1], points: { show: false }, ...more,
  });
  function chart(id, series, axes, scales, hooks = {}) {
    const box = $(id);
    charts[id]?.destroy();
    const times = {
      size: 18, gap: 2, font: "11px system-ui, sans-serif", stroke: () => colour("--soft"), space: 60, ticks: { show: false },
      grid: { stroke: () => colour("--grid"), width: 1 }, values: (u, splits) => splits.map((v) => `${short(v, 4)} s`),
    };
    charts[id] = new uPlot({
      width: box.clientWidth || 300, height: box.clientHeight || 100, cursor: { show: false }, legend: { show: false }, select: { show: false },
      padding: [6, 8, 0, 0], scales: { x: { time: false }, ...scales }, series: [{}, ...series], axes: [times, ...axes], hooks,
    }, [[], ...series.map(() => [])], box);
  }
  const even = (least) => (u, low, high) => {
    if (low == null || high == null) return [-least, least];
    const most = 1.1 * Math.max(Math.abs(low), Math.abs(high), least);
    return [-most, most];
  };
  const levels = (scale, values, style) => (u) => {  // level lines across a chart
    const c = u.ctx;
    c.save(); c.strokeStyle = colour(style); c.lineWidth = devicePixelRatio; c.setLineDash([6 * devicePixelRatio, 4 * devicePixelRatio]);
    for (const v of values()) {
      const y = u.valToPos(v, scale, true);
      if (!(y >= u.bbox.top && y <= u.bbox.top + u.bbox.height)) continue;
      c.beginPath(); c.moveTo(u.bbox.left, y); c.lineTo(u.bbox.left + u.bbox.width, y); c.stroke();
    }
    c.restore();
  };
  const boundAt = (t) => { let found = null; for (const one of bounds) if (one.t <= t + 1e-6) found = one; return found; };
  function drawBound(u) {  // what would be left, had the best of all inputs been chosen from the start of the task
    const one = boundAt(shown);
    if (!one || one.cost == null) return;
    const c = u.ctx, { left, top, width, height } = u.bbox;
    c.save(); c.beginPath(); c.rect(left, top, width, height); c.clip();
    c.strokeStyle = colour("--green"); c.lineWidth = 2 * devicePixelRatio; c.setLineDash([7 * devicePixelRatio, 4 * devicePixelRatio]);
    c.beginPath();
    let begun = false;
    for (let k = 0; k < one.times.length && one.times[k] <= shown; k++) {
      if (!(one.left[k] > 0)) break;
      const x = u.valToPos(one.times[k], "x", true), y = u.valToPos(one.left[k], "J", true);
      begun ? c.lineTo(x, y) : c.moveTo(x, y); begun = true;
    }
    c.stroke(); c.restore();
  }
  let said = "";
  function wordCost() {
    const one = boundAt(shown), first = one && plans.find((p) => p.predicted > 0 && Math.abs(p.t - one.t) < 0.02);
    const ratio = one?.cost > 0 && first ? `, first prediction ${short(first.predicted / one.cost)} ×` : "";
    const words = one?.cost > 0 ? `best of all inputs ${short(one.cost)}${ratio}` : "";
    if (words === said) return;
    said = words;
    costLegend(words);
  }
  const limitOf = (channel) => controls.get(`limit ${channel.name}`)?.value ?? channel.limit;
  function makeCharts() {
    const units = [...new Set(hello.coordinates.map((c) => c.unit))];
    chart("states", hello.coordinates.map((c, k) => line(k, c.unit)), units.map((u, k) => axisOf(u, u, k ? 1 : 3)),
      Object.fromEntries(units.map((u) => [u, { range: even(u === "°" ? 2 : 0.02) }])));
    const kinds = [...new Set(hello.inputs.map((one) => one.unit))];
    chart("input", hello.inputs.map((one, k) => line(k, one.unit || "u")), kinds.map((u, k) => axisOf(u || "u", u, k ? 1 : 3)),
      Object.fromEntries(kinds.map((u) => [u || "u", { range: () => {
        const most = Math.max(...hello.inputs.filter((one) => one.unit === u).map((one) => limitOf(one) ?? biggest(one)));
        return [-1.12 * most, 1.12 * most];
      } }])),
      { draw: hello.inputs.filter((one) => one.limit != null).map((one) => levels(one.unit || "u", () => [limitOf(one), -limitOf(one)], "--red")) });
    const layer = () => planAt(shown)?.layer ?? [];
    chart("s", hello.inputs.map((_, k) => line(k, "s")), [axisOf("s", "", 3, (u, k, low, high) => { const up = high > 20 ? [1, 100] : high > 2 ? [1, 10] : [0.1, 1]; return [-up[1], -up[0], 0, ...up].filter((v) => v >= low && v <= high); })],
      { s: { distr: 4, asinh: 0.1, range: (u, low, high) => { const most = Math.max(0.4, Math.abs(low ?? 0), Math.abs(high ?? 0)); return [-1.3 * most, 1.3 * most]; } } },
      { draw: [levels("s", () => layer().flatMap((v) => [v, -v]), "--red")] });
    chart("cost", [line(0, "J"), line(4, "J", { paths: () => null, dash: [], points: { show: true, size: 7, stroke: () => colour("--red"), fill: () => colour("--red") } })],
      [axisOf("J", "", 3, (u, k, low, high) => { const all = tens(low, high); return all.filter((_, i) => (all.length - 1 - i) % Math.ceil(all.length / 4) === 0); })], { J: { distr: 3, range: (u, low, high) => {
        if (low == null || !(high > 0)) return [0.1, 1];
        const top = 10 ** Math.ceil(Math.log10(1.001 * high));
        return [Math.max(10 ** Math.floor(Math.log10(Math.max(low, 1e-12))), top * 1e-6), top];
      } } }, { draw: [drawBound] });
    chart("ms", [line(0, "ms", { paths: uPlot.paths.bars({ size: [0.6, 9], align: 0 }), fill: () => colour("--blue"), width: 0 })], [axisOf("ms", "", 3, (u, k, low, high) => [0, nice(0.9 * high)])],
      { ms: { range: (u, low, high) => [0, 1.15 * Math.max(high ?? 0, 5)] } });
  }
  const biggest = (one) => { const k = hello.inputs.indexOf(one); return Math.max(0.1, ...(live ? frames.slice(-480) : frames).map((f) => Math.abs(f.u[k]))); };
  function makeLegends() {
    const entry = (k, text) => {
      const one = document.createElement("span"), mark = document.createElement("i"), dash = STYLES[k % STYLES.length][1];
      mark.style.borderTopColor = `var(${STYLES[k % STYLES.length][0]})`;
      if (dash.length) mark.className = dash[0] > 4 ? "dashed" : "dotted";
      one.append(mark, text);
      return one;
    };
    $("legend-states").replaceChildren(...hello.coordinates.map((c, k) => entry(k, `${c.name}, ${c.unit}`)));
    $("legend-input").replaceChildren(...hello.inputs.map((one, k) => entry(k, one.unit ? `${one.name}, ${one.unit}` : one.name)), hello.inputs.some((one) => one.limit != null) ? "- - limit" : "");
    $("legend-s").replaceChildren(...(hello.inputs.length > 1 ? hello.inputs.map((_, k) => entry(k, `s${k + 1}`)) : []), "- - layer ±ε");
    costLegend = (words) => {
      const dot = document.createElement("span"), own = [entry(0, "predicted less spent"), dot];
      dot.textContent = "● predicted"; dot.style.color = "var(--red)";
      if (words) own.push(entry(2, words));
      $("legend-cost").replaceChildren(...own);
    };
    costLegend(said);
    const mark = (text, name) => { const one = document.createElement("span"); one.textContent = text; one.style.color = `var(${name})`; return one; };
    $("legend-plausible").replaceChildren(mark("| ensemble", "--blue"), mark("● estimate", "--blue"), ...(live && !watched ? [mark("◆ true plant", "--orange")] : []));
  }
  let costLegend = () => {};
  function drawCharts() {
    const from = before(frames, shown - WINDOW), to = before(frames, shown);
    const some = frames.slice(from, to + 1), t = some.map((f) => f.t), low = Math.max(shown - WINDOW, frames.length ? frames[0].t : 0);
    const x = { min: low, max: Math.max(shown, low + 1) };
    const set = (id, data) => { charts[id].setData(data, false); charts[id].setScale("x", x); };
    set("states", [t, ...hello.coordinates.map((c, k) => some.map((f, j) => (j && turned(from + j, k) ? null : f.x[k] * c.factor)))]);
    set("input", [t, ...hello.inputs.map((_, k) => some.map((f) => f.u[k]))]);
    set("s", [t, ...hello.inputs.map((_, k) => some.map((f) => f.s[k]))]);
    const decided = plans.filter((p) => p.kind === "plan" && p.t >= x.min && p.t <= shown);
    const above = (v) => (v > 1e-12 ? v : null), at = new Map();
    for (const f of some) at.set(f.t, [above(f.left), null]);
    for (const p of decided) at.set(p.t, [at.get(p.t)?.[0] ?? null, above(p.predicted)]);
    const all = [...at.keys()].sort((a, b) => a - b);
    wordCost();
    set("cost", [all, all.map((v) => at.get(v)[0] ?? undefined), all.map((v) => at.get(v)[1])]);
    const timed = decided.filter((p) => p.ms != null && !p.first), times = new Map(timed.map((p) => [p.t, p.ms]));
    set("ms", [[...times.keys()], [...times.values()]]);
  }
  const took = (p) => (p.ms < 1000 ? `${short(p.ms)} ms` : `${short(p.ms / 1000, 2)} s`);
  let learnt = {};
  function drawLearnt() {  // what the controller takes the plant's parameters to be by now
    learnt = planAt(shown)?.learnt ?? {};
    for (const name of Object.keys(learnt)) if (controls.has(`plant ${name}`)) put(controls.get(`plant ${name}`));
  }
  function drawPlausible(plan) {  // the ensemble thins as it learns: its members close in on the estimate
    const rows = plan?.plausible ?? [], box = $("plausible-box"), canvas = $("plausible");
    if (box.hidden !== !rows.length) box.hidden = !rows.length;
    if (!rows.length) return;
    const tall = 20, height = `${tall * rows.length}px`;
    if (canvas.style.height !== height) canvas.style.height = height;
    const [c, w] = fit(canvas), from = 0.24 * w, to = w - 74;
    c.font = "12px system-ui, sans-serif"; c.textBaseline = "middle"; c.setLineDash([]);
    rows.forEach((row, k) => {
      const y = tall * (k + 0.5), middle = 0.5 * (row.low + row.high), half = row.high - middle;
      const at = (v) => clamp(from + ((v - middle) / (2 * half) + 0.5) * (to - from), from, to);  // twice the tolerance
      c.fillStyle = colour("--soft"); c.textAlign = "right"; c.fillText(row.name, from - 10, y);
      c.textAlign = "left"; c.fillText(short(row.estimate), to + 10, y);
      c.fillStyle = colour("--grid"); c.fillRect(at(row.low), y - 6, at(row.high) - at(row.low), 12);
      c.strokeStyle = colour("--blue"); c.lineWidth = 2; c.globalAlpha = 0.55; c.beginPath();
      for (const v of row.members) { c.moveTo(at(v), y - 6); c.lineTo(at(v), y + 6); }
      c.stroke(); c.globalAlpha = 1;
      c.fillStyle = colour("--blue"); c.beginPath(); c.arc(at(row.estimate), y, 4, 0, 7); c.fill();
      const truth = controls.get(`plant ${row.name}`)?.value;
      if (truth != null) { c.fillStyle = colour("--orange"); const x = at(truth); c.beginPath(); c.moveTo(x, y - 7); c.lineTo(x + 5, y); c.lineTo(x, y + 7); c.lineTo(x - 5, y); c.fill(); }
    });
  }
  function drawPlans() {
    const until = plans.filter((p) => p.t <= shown + 1e-6).slice(-14).reverse();
    const key = until.map((p) => `${p.t}${p.why}`).join();
    if (key === listed) return;
    listed = key;
    drawLearnt();
    $("plans").replaceChildren(...until.map((p) => {
      const item = document.createElement("li"), head = document.createElement("b"), why = document.createElement("span");
      item.className = p.kind === "event" ? "" : p.accepted ? "yes" : "no";
      head.textContent = `${p.t.toFixed(2)} s${p.ms != null ? `, ${took(p)}` : ""}`;
      why.textContent = p.why;
      item.append(head, why);
      return item;
    }));
    const last = until.find((p) => p.ms != null);
    $("took").textContent = last ? took(last) : "";
  }

  // -- words -----------------------------------------------------------------------------------
  function drawWords(frame) {
    const mode = $("mode");
    let words = "", style = "";
    if (!live || watched) { words = frame?.mode ?? (watched ? "Not begun" : null) ?? (playing ? "Recording" : "Recording, paused"); words = words[0].toUpperCase() + words.slice(1); }
    else if (state.mode === "waiting") words = "Looking for the first surface…";
    else if (state.mode === "fallen") [words, style] = ["Fallen", "bad"];
    else if (state.paused) words = "Paused";
    else if (frame?.held) words = "Held by hand";
    else if (state.there) [words, style] = ["At the target", "good"];
    else words = "On its way";
    mode.textContent = words; mode.className = style;
    const speed = live ? state.speed : rate;
    $("clock").textContent = `${shown.toFixed(2)} s${speed < 1 ? `, ${short(1 / speed)}× slow motion` : ""}`;
    const banner = $("banner");
    const waits = live && state.mode === "waiting" && performance.now() - waitingSince > 2500;
    const kind = waits || (live && state.mode === "fallen") ? state.mode : performance.now() < noteUntil ? "note" : "";
    if (banner.dataset.kind !== kind + state.why + note) {
      banner.dataset.kind = kind + state.why + note;
      banner.replaceChildren();
      banner.hidden = !kind;
      banner.className = kind;
      $("hint").hidden = !!kind;
      const add = (tag, words) => { const one = document.createElement(tag); one.textContent = words; banner.append(one); return one; };
      if (kind === "fallen") {
        add("strong", "It has fallen.");
        add("span", `${state.why[0]?.toUpperCase() ?? ""}${state.why.slice(1)}. Lift it with the mouse until it is caught, or begin again:`);
        add("button", "Reset (R)").onclick = reset;
      } else if (kind === "waiting") add("span", "The first search of a mechanism or objective compiles it, once: half a minute, or more for large ones.");
      else if (kind === "note") add("span", note);
    }
    if (state.mode !== "waiting") waitingSince = performance.now();
  }
  let waitingSince = performance.now();

  // -- the loop --------------------------------------------------------------------------------
  let previous = performance.now(), chartsDue = 0;
  function tick(now) {
    requestAnimationFrame(tick);
    const passed = Math.min(0.1, (now - previous) / 1000);
    previous = now;
    if (now - counted > 1000) { fps = (1000 * drawn) / (now - counted); drawn = 0; counted = now; }
    if (!hello) return;
    if (live) {
      if (drag) { say({ do: "drag", at: drag }); drag = null; }
      const aim = latest() - (state.paused ? 0 : (hello.behind ?? BEHIND) * state.speed);
      const next = shown + (state.paused ? 0 : passed * state.speed);
      shown = Math.abs(next - aim) > 0.25 ? aim : next + 0.1 * (aim - next);
      if (state.paused) shown = latest();
    } else if (playing && frames.length) {
      shown = Math.min(latest(), shown + passed * rate);
      if (shown >= latest()) { playing = false; showTransport(); }
    }
    if (!live) $("time").value = shown;
    const frame = frameAt(shown), plan = planAt(shown);
    drawScene(frame, plan);
    if (now >= chartsDue && frames.length) { chartsDue = now + 45; drawPhase(frame, plan); drawCharts(); drawPlans(); drawPlausible(plan); drawWords(frame); }
    else if (!frames.length) drawWords(frame);
    drawn += 1;
  }
  new ResizeObserver(() => { for (const [id, one] of Object.entries(charts)) one.setSize({ width: $(id).clientWidth, height: $(id).clientHeight }); }).observe($("side"));

  // What tests, and the curious, can look at.
  window.undertow = {
    get state() { return { ...state, live, watched, shown, playing, fps, connected: socket?.readyState === 1, note: performance.now() < noteUntil ? note : "" }; },
    get frame() { return frameAt(shown); },
    get window() { const x = charts.states.scales.x; return { min: x.min, max: x.max }; },
    get bounds() { return bounds; }, get region() { return region; },
    get frames() { return frames; }, get plans() { return plans; }, get hello() { return hello; },
    get controls() { return Object.fromEntries(controls); },
    pixel: (x, y) => { const b = $("scene").getBoundingClientRect(), m = mapping(b.width, b.height); return [b.left + m.x(x), b.top + m.y(y)]; },
    disconnect: () => socket?.close(),
  };
  const recorded = document.getElementById("recording");
  if (recorded) { link("recording"); begin(JSON.parse(recorded.textContent)); } else connect();
  requestAnimationFrame(tick);
})();

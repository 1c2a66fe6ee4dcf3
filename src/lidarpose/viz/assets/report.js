"use strict";
// Turnable 3D views on 2D canvases. The level frame: x forward, y left, z up; millimeters about the person's middle.
// A view looks from azimuth `turn` and elevation `tilt` at the person; depth grows towards the viewer.
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const calm = matchMedia("(prefers-reduced-motion: reduce)");
  const toggles = Object.fromEntries(["points", "pose", "truth", "spin"].map((id) => [id, document.getElementById(id)]));
  const SHADES = 7, SHADE_SPAN = 350;   // steps of the points' gray, mm about the middle over which it runs
  const EYE = 6500, FAR = 1.5;          // mm from the person to the eye, of a scan its width: a mild perspective
  const GRID = 500, REACH = 1000;       // mm: a square of the ground, how far it runs at least
  const SPIN = 0.00035;                 // rad per millisecond
  const START = {turn: 0.5, tilt: 0.16, zoom: 1}, ABOVE = {turn: 3.6, tilt: 0.7, zoom: 1};
  let color = {};

  function readColors() {
    const style = getComputedStyle(document.documentElement);
    const get = (name) => style.getPropertyValue("--" + name).trim();
    color = Object.fromEntries(["truth", "ground", "halo", "ink", "faint", "card"].map((n) => [n, get(n)]));
    Object.assign(color, {l: get("left"), r: get("right"), c: get("center"), n: get("stray")});
    const rgb = (hex) => [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16));
    const near = rgb(get("near")), far = rgb(get("far"));
    color.shade = Array.from({length: SHADES}, (_, i) => {
      const t = i / (SHADES - 1);
      return "rgb(" + near.map((n, k) => Math.round(n * t + far[k] * (1 - t))).join(",") + ")";
    });
  }

  // what a person spans: the ground below, the middle to look at, the radius to fit
  function bounds(person) {
    const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
    const values = [[], [], []];
    for (let i = 0; i < person.points.length; i++) values[i % 3].push(person.points[i]);
    for (let k = 0; k < 3; k++) {
      const sorted = values[k].sort((a, b) => a - b), n = sorted.length;   // the outermost percent may lie outside
      if (n) { low[k] = sorted[Math.floor(n * 0.01)]; high[k] = sorted[Math.ceil(n * 0.99) - 1]; }
    }
    for (const pose of [person.pose, person.truth]) for (const joint of pose ? pose.joints : []) {
      if (joint) for (let k = 0; k < 3; k++) { low[k] = Math.min(low[k], joint[k]); high[k] = Math.max(high[k], joint[k]); }
    }
    // of a scan the people, all of it where there are none
    const panels = person.poses ? [person, ...(person.frames || [])] : [];
    const joints = panels.flatMap((one) => one.poses).flatMap((pose) => pose.joints.filter((joint) => joint));
    if (!isFinite(low[0]) && !joints.length) return null;
    if (person.poses) {
      const end = (of, k) => joints.reduce((best, joint) => of(best, joint[k]), joints[0][k]);
      const a = joints.length ? low.map((_, k) => end(Math.min, k)) : low;
      const b = joints.length ? high.map((_, k) => end(Math.max, k)) : high;
      const wide = Math.max(Math.hypot(b[0] - a[0], b[1] - a[1]) + 2000, 6000);
      return {center: a.map((v, k) => (v + b[k]) / 2), ground: a[2], tall: wide * 0.6, wide};
    }
    const center = low.map((v, k) => (v + high[k]) / 2);
    const tall = Math.max(high[2] - low[2], 1500), wide = Math.max(Math.hypot(high[0] - low[0], high[1] - low[1]), 800);
    return {center, ground: low[2], tall: Math.min(tall, 5000), wide: Math.min(wide, 5000)};
  }

  function makeView(canvas) {
    const key = canvas.dataset.person, scan = key.startsWith("scan");
    const person = scan ? data.scans[+key.slice(4)] : data.people[+key];
    const start = scan ? ABOVE : {...START, turn: START.turn + (person.facing || 0)};
    const view = {canvas, person, span: bounds(person), ...start, touched: scan, visible: true, hover: null};
    if (person.frames) makePlayer(view);
    const fingers = new Map();
    let pinch = 0;
    view.reset = () => Object.assign(view, start, {touched: scan, hover: null});
    const touch = () => { view.touched = true; ask(view); };
    const zoom = (factor) => { view.zoom = Math.min(scan ? 40 : 6, Math.max(0.3, view.zoom * factor)); touch(); };
    const gap = () => { const [a, b] = [...fingers.values()]; return Math.hypot(a.x - b.x, a.y - b.y); };

    canvas.addEventListener("pointerdown", (e) => {
      canvas.setPointerCapture(e.pointerId);
      fingers.set(e.pointerId, {x: e.clientX, y: e.clientY});
      if (fingers.size === 2) pinch = gap();
      touch();
    });
    canvas.addEventListener("pointermove", (e) => {
      const last = fingers.get(e.pointerId);
      const box = canvas.getBoundingClientRect();
      view.hover = e.pointerType === "mouse" && !last ? {x: e.clientX - box.left, y: e.clientY - box.top} : null;
      if (last && fingers.size === 1) {
        view.turn -= (e.clientX - last.x) * 0.009;
        view.tilt = Math.min(1.5, Math.max(-0.3, view.tilt + (e.clientY - last.y) * 0.007));
      }
      if (last) fingers.set(e.pointerId, {x: e.clientX, y: e.clientY});
      if (fingers.size === 2) { const now = gap(); zoom(now / (pinch || now)); pinch = now; }
      ask(view);
    });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (e) => fingers.delete(e.pointerId));
    canvas.addEventListener("pointerleave", () => { view.hover = null; ask(view); });
    // the wheel zooms a view that was clicked; over any other it goes on scrolling the page
    canvas.addEventListener("wheel", (e) => {
      if (document.activeElement !== canvas && !e.ctrlKey) return;
      e.preventDefault();
      zoom(Math.exp(-e.deltaY * (e.deltaMode ? 0.03 : 0.0015)));
    }, {passive: false});
    canvas.addEventListener("dblclick", () => { view.reset(); ask(view); });
    canvas.addEventListener("keydown", (e) => {
      const act = {
        ArrowLeft: () => { view.turn += 0.12; }, ArrowRight: () => { view.turn -= 0.12; },
        ArrowUp: () => { view.tilt = Math.max(-0.3, view.tilt - 0.08); },
        ArrowDown: () => { view.tilt = Math.min(1.5, view.tilt + 0.08); },
        "+": () => zoom(1.15), "-": () => zoom(1 / 1.15), "0": view.reset,
      }[e.key];
      if (!act) return;
      e.preventDefault();
      touch();
      act();
    });
    return view;
  }

  // people over time: a slider, and a button that plays
  function makePlayer(view) {
    const {frames, step} = view.person, player = view.canvas.parentElement.querySelector(".player");
    const [button, slider, text] = ["button", "input", "output"].map((name) => player.querySelector(name));
    let timer = null;
    const show = (k) => { view.frame = k; slider.value = k; text.textContent = frames[k].label; ask(view); };
    const stop = () => { clearInterval(timer); timer = null; button.textContent = "play"; };
    button.addEventListener("click", () => {
      if (timer !== null) { stop(); return; }
      button.textContent = "pause";
      timer = setInterval(() => show((view.frame + 1) % frames.length), step);
    });
    slider.addEventListener("input", () => { stop(); show(+slider.value); });
    view.frame = 0;
    text.textContent = frames[0].label;
    button.hidden = slider.hidden = frames.length < 2;
  }

  function draw(view) {
    const {canvas, person, span} = view, pen = canvas.getContext("2d");
    const ratio = Math.min(devicePixelRatio || 1, 2), width = canvas.clientWidth, height = canvas.clientHeight;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    if (!span) {
      pen.fillStyle = color.faint;
      pen.font = "13px system-ui, sans-serif";
      pen.textAlign = "center";
      pen.fillText("no points", width / 2, height / 2);
      return;
    }
    const ct = Math.cos(view.turn), st = Math.sin(view.turn), ce = Math.cos(view.tilt), se = Math.sin(view.tilt);
    const scale = view.zoom * Math.min(height * 0.8 / span.tall, width * 0.86 / span.wide);
    const [mx, my, mz] = span.center, eye = person.poses ? FAR * span.wide : EYE;
    // (x, y, z) mm -> [pixels right, pixels down, mm towards the viewer]
    const place = (x, y, z) => {
      const dx = x - mx, dy = y - my, dz = z - mz;
      const toward = ct * dx + st * dy, depth = ce * toward + se * dz;
      const size = scale * eye / Math.max(eye - depth, 300);
      return [width / 2 + (ct * dy - st * dx) * size, height * 0.475 - (ce * dz - se * toward) * size, depth];
    };
    const line = (a, b) => { pen.beginPath(); pen.moveTo(a[0], a[1]); pen.lineTo(b[0], b[1]); pen.stroke(); };
    pen.lineCap = "round";
    if (!person.poses) drawGround(view, pen, place, line);
    const moving = person.frames ? person.frames[view.frame] : null;
    if (toggles.points.checked) {
      drawPoints(view, pen, place, person);
      if (moving) drawPoints(view, pen, place, moving);
    }
    if (toggles.truth.checked && person.truth) {
      const at = person.truth.joints.map((j) => j && place(...j));
      pen.strokeStyle = color.truth;
      pen.lineWidth = 1.6;
      pen.setLineDash([5, 4]);
      for (const [a, b] of data.skeletons[person.truth.skeleton].bones) if (at[a] && at[b]) line(at[a], at[b]);
      pen.setLineDash([]);
    }
    const poses = moving ? moving.poses : person.poses || (person.pose ? [person.pose] : []);
    const toggle = person.labeled ? toggles.truth : toggles.pose;
    if (toggle.checked) for (const pose of poses) drawPose(view, pose, pen, place, line);
  }

  function drawGround(view, pen, place, line) {
    const {center: [mx, my], ground, wide} = view.span;
    const half = Math.ceil(Math.max(REACH, wide / 2 + 200) / GRID) * GRID;
    pen.strokeStyle = color.ground;
    pen.lineWidth = 1;
    for (let k = -half; k <= half; k += GRID) {
      line(place(mx + k, my - half, ground), place(mx + k, my + half, ground));
      line(place(mx - half, my + k, ground), place(mx + half, my + k, ground));
    }
    const facing = view.person.facing;
    if (facing === null) return;
    const c = Math.cos(facing), s = Math.sin(facing);
    const spot = (forward, left) => place(mx + c * forward - s * left, my + s * forward + c * left, ground);
    const ends = [spot(250, 0), spot(620, 0), spot(760, 0), spot(600, 75), spot(600, -75)];
    pen.strokeStyle = pen.fillStyle = color.faint;
    pen.lineWidth = 2;
    line(ends[0], ends[1]);
    pen.beginPath();
    for (const k of [2, 3, 4]) pen.lineTo(ends[k][0], ends[k][1]);
    pen.fill();
  }

  function drawPoints(view, pen, place, of) {
    const {points: p, sides, poses} = of, reach = poses ? view.span.wide / 2 : SHADE_SPAN;
    const shades = Array.from({length: SHADES}, () => []);
    for (let i = 0; i < p.length; i += 3) {
      const at = place(p[i], p[i + 1], p[i + 2]);
      const shade = Math.floor((at[2] / reach + 1) / 2 * SHADES);
      if (sides) at[2] = sides[i / 3];
      shades[Math.min(SHADES - 1, Math.max(0, shade))].push(at);
    }
    const size = Math.min(4, Math.max(1.6, 34 / Math.sqrt(p.length / 3 + 1))) * Math.min(2, Math.sqrt(view.zoom));
    shades.forEach((points, i) => {
      pen.fillStyle = color.shade[i];
      if (sides) pen.globalAlpha = 0.35 + 0.45 * i / (SHADES - 1);   // the farther the fainter
      for (const [x, y, side] of points) {
        if (sides) pen.fillStyle = color[side];
        pen.fillRect(x - size / 2, y - size / 2, size, size);
      }
    });
    pen.globalAlpha = 1;
  }

  function drawPose(view, pose, pen, place, line) {
    const {truth} = view.person, skeleton = data.skeletons[pose.skeleton];
    const at = pose.joints.map((j) => j && place(...j));
    const sure = pose.confidence || pose.joints.map(() => 1);
    const ink = (c) => 0.2 + 0.8 * c;
    const bones = skeleton.bones.filter(([a, b]) => at[a] && at[b]);
    bones.sort((p, q) => at[p[0]][2] + at[p[1]][2] - at[q[0]][2] - at[q[1]][2]);   // far ones first
    for (const [a, b, side] of bones) {
      const mid = [(at[a][0] + at[b][0]) / 2, (at[a][1] + at[b][1]) / 2];
      pen.strokeStyle = color.halo;
      pen.globalAlpha = 0.7 * Math.min(sure[a], sure[b]);
      pen.lineWidth = 6;
      line(at[a], at[b]);
      pen.strokeStyle = color[side];
      pen.lineCap = "butt";
      for (const [end, c] of [[at[a], sure[a]], [at[b], sure[b]]]) {   // each half as sure as its own joint
        pen.globalAlpha = ink(c);
        pen.lineWidth = 2 + 2 * c;
        line(end, mid);
      }
      pen.lineCap = "round";
    }
    at.forEach((spot, j) => {
      if (!spot) return;
      pen.globalAlpha = ink(sure[j]);
      pen.fillStyle = color[skeleton.sides[j]];
      pen.beginPath();
      pen.arc(spot[0], spot[1], 3.1, 0, 2 * Math.PI);
      pen.fill();
    });
    pen.globalAlpha = 1;
    if (pose.name) {
      const top = at.filter((spot) => spot).reduce((a, b) => (b[1] < a[1] ? b : a));
      pen.fillStyle = color.ink;
      pen.font = "600 13px system-ui, sans-serif";
      pen.textAlign = "center";
      pen.fillText(pose.name, top[0], top[1] - 10);
    }
    if (view.hover) drawHover(view, pen, at, pose, truth, skeleton);
  }

  // names the joint under the pointer, its confidence and its error
  function drawHover(view, pen, at, pose, truth, skeleton) {
    let best = -1, nearest = 14;
    at.forEach((spot, j) => {
      const gap = spot ? Math.hypot(spot[0] - view.hover.x, spot[1] - view.hover.y) : Infinity;
      if (gap < nearest) { nearest = gap; best = j; }
    });
    if (best < 0) return;
    const name = skeleton.joints[best], words = [name.replaceAll("_", " ")];
    if (pose.confidence) words.push("confidence " + pose.confidence[best].toFixed(2));
    const other = truth ? truth.joints[data.skeletons[truth.skeleton].joints.indexOf(name)] : null;
    if (other) words.push("off by " + Math.round(Math.hypot(...other.map((v, k) => v - pose.joints[best][k]))) + " mm");
    const text = words.join(" · ");
    pen.font = "12px system-ui, sans-serif";
    pen.textAlign = "left";
    const wide = pen.measureText(text).width + 14;
    const x = Math.min(Math.max(at[best][0] + 10, 4), Math.max(4, view.canvas.clientWidth - wide - 4));
    const y = Math.max(at[best][1] - 30, 4);
    pen.fillStyle = color.ink;
    pen.fillRect(x, y, wide, 22);
    pen.fillStyle = color.card;
    pen.fillText(text, x + 7, y + 15);
  }

  // only what changed and can be seen is drawn
  const views = [...document.querySelectorAll("canvas[data-person]")].map(makeView);
  const waiting = new Set(views);
  let last = null, running = false;
  const spins = (view) => toggles.spin.checked && !calm.matches && !view.touched && view.visible && view.span;

  function frame(now) {
    const step = last === null ? 0 : Math.min(now - last, 100);
    last = now;
    for (const view of views) {
      if (spins(view)) { view.turn += step * SPIN; waiting.add(view); }
      if (waiting.has(view) && view.visible) { waiting.delete(view); draw(view); }
    }
    running = views.some(spins);
    if (running) requestAnimationFrame(frame); else last = null;
  }
  function wake() { if (!running) { running = true; requestAnimationFrame(frame); } }
  function ask(view) { waiting.add(view); wake(); }
  function askAll() { views.forEach(ask); }

  for (const toggle of Object.values(toggles)) toggle.addEventListener("change", askAll);
  dark.addEventListener("change", () => { readColors(); askAll(); });
  calm.addEventListener("change", askAll);
  const observer = new IntersectionObserver((entries) => {
    for (const entry of entries) {
      const view = views.find((v) => v.canvas === entry.target);
      view.visible = entry.isIntersecting;
      if (view.visible) ask(view);
    }
  });
  const resized = new ResizeObserver((entries) => {
    for (const entry of entries) ask(views.find((v) => v.canvas === entry.target));
  });
  for (const view of views) { observer.observe(view.canvas); resized.observe(view.canvas); }
  // what nobody has needs no legend
  for (const words of document.querySelectorAll("[data-if]")) {
    words.hidden = ![...data.people, ...data.scans].some((shown) => words.dataset.if.split(" ").some((key) => shown[key] || shown[key] === 0));
  }
  readColors();
  views.forEach(draw);
  wake();
})();

// Draws the scenes of the report on a canvas: the surface of an object, its candidate views, and a walk of the camera.
// Frames: world right-handed, z up; the eye looks at the origin from azimuth and elevation, in radians.
(() => {
  "use strict";
  const $ = (id) => document.getElementById(id);
  const canvas = $("scene"), pen = canvas && canvas.getContext("2d");
  if (!pen) return; // without a canvas, the static pictures stay
  const data = JSON.parse($("scenes").textContent), sections = [...document.querySelectorAll("#walks .walk")];
  if (!data.scenes.length) return;
  const RADIUS = 1.45, DISTANCE = 6, SHADES = 24, START = { azimuth: 0.7, elevation: 0.4, zoom: 1 };
  const SIZES = [0.45, 0.8, 1.6]; // of points in cells of the grid: not seen yet, seen before, new
  const SMALLER = Math.max(0.55, Math.min(1, Math.sqrt(60 / data.directions.length))); // many candidates are drawn smaller
  const eye = { ...START };
  let scene, step = 1, colours = {}, waiting = false;

  // Vectors, and the way from the world to the canvas.
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const sum = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
  const times = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const unit = (a) => times(a, 1 / (Math.hypot(...a) || 1));
  const axes = (azimuth, elevation) => {
    const [ca, sa, ce, se] = [Math.cos(azimuth), Math.sin(azimuth), Math.cos(elevation), Math.sin(elevation)];
    return { right: [-sa, ca, 0], up: [-se * ca, -se * sa, ce], towards: [ce * ca, ce * sa, se] };
  };
  const frame = () => {
    const size = Math.min(canvas.clientWidth, canvas.clientHeight);
    return { ...axes(eye.azimuth, eye.elevation), unit: (eye.zoom * size) / 3.4,
      x: canvas.clientWidth / 2, y: canvas.clientHeight / 2 };
  };
  const project = (f, p) => {
    const depth = dot(p, f.towards), near = (f.unit * DISTANCE) / (DISTANCE - depth);
    return { x: f.x + near * dot(p, f.right), y: f.y - near * dot(p, f.up), depth, near };
  };

  // Data: coordinates in two bytes, normals in one, the step that first shows a point.
  const unpack = (found) => {
    if (found.cloud) return found.cloud;
    const bytes = Uint8Array.from(atob(found.points), (letter) => letter.charCodeAt(0)), n = found.count;
    const view = new DataView(bytes.buffer), points = new Float32Array(3 * n), normals = new Float32Array(3 * n);
    for (let i = 0; i < 3 * n; i++) {
      points[i] = view.getInt16(2 * i, true) / 20000;
      normals[i] = view.getInt8(6 * n + i) / 127;
    }
    return (found.cloud = { points, normals, first: bytes.subarray(9 * n), n });
  };

  const rgb = (name) => {
    const text = getComputedStyle(document.documentElement).getPropertyValue(name).trim().replace("#", "");
    const long = text.length === 3 ? [...text].map((c) => c + c).join("") : text;
    return [0, 2, 4].map((i) => parseInt(long.slice(i, i + 2), 16));
  };
  const css = (c) => `rgb(${c.map(Math.round).join(",")})`;
  const mixed = (a, b, s) => css(a.map((value, i) => value + s * (b[i] - value)));
  const readColours = () => {
    const of = {};
    for (const name of ["paper", "ink", "note", "gain-low", "gain-high", "unseen", "seen", "new", "path"]) of[name] = rgb(`--${name}`);
    const shaded = (c) => Array.from({ length: SHADES }, (_, i) => css(c.map((v) => v * (0.35 + (0.65 * i) / (SHADES - 1)))));
    colours = { ...of, shades: [shaded(of.unseen), shaded(of.seen), shaded(of.new)] };
  };

  const drawCloud = (f) => {
    const cloud = unpack(scene), light = unit(sum(sum(f.towards, f.up, 0.5), f.right, 0.35));
    const depths = new Float32Array(cloud.n), order = new Uint16Array(cloud.n);
    const at = (a, i) => [a[3 * i], a[3 * i + 1], a[3 * i + 2]];
    for (let i = 0; i < cloud.n; i++) {
      order[i] = i;
      depths[i] = dot(at(cloud.points, i), f.towards);
    }
    order.sort((i, j) => depths[i] - depths[j]);
    for (const i of order) {
      const first = cloud.first[i], state = first === 0 || first > step ? 0 : first === step ? 2 : 1;
      const p = project(f, at(cloud.points, i)), shade = Math.max(0, dot(at(cloud.normals, i), light));
      const side = scene.spacing * p.near * SIZES[state];
      pen.fillStyle = colours.shades[state][Math.round(shade * (SHADES - 1))];
      pen.fillRect(p.x - side / 2, p.y - side / 2, side, side);
    }
  };

  const line = (f, points, style, width, dash = []) => {
    pen.beginPath();
    points.forEach((p, i) => {
      const at = project(f, p);
      if (i) pen.lineTo(at.x, at.y);
      else pen.moveTo(at.x, at.y);
    });
    pen.strokeStyle = style;
    pen.lineWidth = width;
    pen.setLineDash(dash);
    pen.stroke();
    pen.setLineDash([]);
  };
  // The way between two directions, in pieces, so that each is drawn before or behind the object.
  const arc = (a, b) => {
    const cosine = Math.max(-1, Math.min(1, dot(a, b))), angle = Math.acos(cosine), opposite = Math.abs(cosine) > 0.9999;
    const side = unit(opposite ? cross(a, Math.abs(a[2]) > 0.9 ? [1, 0, 0] : [0, 0, 1]) : sum(b, a, -cosine));
    return Array.from({ length: 25 }, (_, i) => (i / 24) * angle).map((t) => times(sum(times(a, Math.cos(t)), side, Math.sin(t)), RADIUS));
  };
  const pieces = (f, path, front, style, width, dash) => {
    for (let i = 1; i < path.length; i++) {
      if (dot(sum(path[i - 1], path[i]), f.towards) >= 0 === front) line(f, [path[i - 1], path[i]], style, width, dash);
    }
  };
  const ring = Array.from({ length: 65 }, (_, i) => [RADIUS * Math.cos((i * Math.PI) / 32), RADIUS * Math.sin((i * Math.PI) / 32), 0]);

  const drawCamera = (f, direction, front) => {
    if (dot(direction, f.towards) >= 0 !== front) return;
    const top = times(direction, RADIUS), right = unit(cross(direction, Math.abs(direction[2]) > 0.999 ? [0, 1, 0] : [0, 0, 1]));
    const up = cross(right, direction), base = times(direction, RADIUS - 0.34);
    const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([x, y]) => sum(sum(base, right, 0.2 * x), up, 0.2 * y));
    for (const corner of corners) line(f, [top, corner], css(colours.path), 2);
    line(f, [...corners, corners[0]], css(colours.path), 2);
  };

  const disc = (p, radius, fill, width = 1.2, dash = []) => {
    pen.beginPath();
    pen.arc(p.x, p.y, radius, 0, 2 * Math.PI);
    if (fill) {
      pen.fillStyle = fill;
      pen.fill();
    }
    pen.strokeStyle = css(colours.ink);
    pen.lineWidth = width;
    pen.setLineDash(dash);
    pen.stroke();
    pen.setLineDash([]);
  };
  const state = () => {
    const seen = scene.stops.slice(0, step).map((stop) => stop.view), gains = scene.stops[step - 1].gains;
    const left = gains.map((_, i) => i).filter((i) => data.reachable[i] && !seen.includes(i)), values = left.map((i) => gains[i]);
    const following = step < scene.stops.length ? scene.stops[step].view : -1;
    return { seen, gains, left, low: Math.min(...values), high: Math.max(...values), following };
  };
  const drawViews = (f, now, front) => {
    const shown = data.directions.map((d, i) => ({ i, ...project(f, times(d, RADIUS)) })).filter((p) => p.depth >= 0 === front);
    for (const p of shown.sort((a, b) => a.depth - b.depth)) {
      const order = now.seen.indexOf(p.i);
      if (order >= 0) {
        disc(p, 11, css(colours.path));
        pen.fillStyle = css(colours.paper);
        pen.font = "bold 13px system-ui,sans-serif";
        pen.textAlign = "center";
        pen.textBaseline = "middle";
        pen.fillText(order + 1, p.x, p.y + 0.5);
      } else if (!data.reachable[p.i]) {
        for (const s of [-1, 1]) {
          pen.beginPath();
          pen.moveTo(p.x - 5 * SMALLER, p.y - 5 * s * SMALLER);
          pen.lineTo(p.x + 5 * SMALLER, p.y + 5 * s * SMALLER);
          pen.strokeStyle = css(colours.note);
          pen.lineWidth = 1.5;
          pen.stroke();
        }
      } else {
        const share = now.high > now.low ? (now.gains[p.i] - now.low) / (now.high - now.low) : 0.5, radius = SMALLER * (3.5 + 6.5 * share);
        disc(p, radius, mixed(colours["gain-low"], colours["gain-high"], share));
        if (p.i === now.following) disc(p, radius + 4, null, 2, [4, 3]);
      }
    }
  };

  const draw = () => {
    waiting = false;
    const ratio = window.devicePixelRatio || 1, f = frame(), now = state();
    canvas.width = Math.round(canvas.clientWidth * ratio);
    canvas.height = Math.round(canvas.clientHeight * ratio);
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    const walk = now.seen.slice(1).flatMap((view, i) => arc(data.directions[now.seen[i]], data.directions[view]));
    for (const front of [false, true]) {
      pieces(f, ring, front, css(colours.note), 1, [2, 5]);
      pieces(f, walk, front, css(colours.path), 2.5, []);
      drawCamera(f, data.directions[now.seen[step - 1]], front);
      drawViews(f, now, front);
      if (!front) drawCloud(f);
    }
  };
  const redraw = () => {
    if (!waiting) requestAnimationFrame(draw);
    waiting = true;
  };

  const percent = (p) => `${(100 * p).toFixed(1)} %`, nats = (gain) => `${gain.toFixed(3)} nats`.replace("-", "−");
  const tell = () => {
    const now = state(), stop = scene.stops[step - 1], [label, p] = stop.bars[0], right = label === scene.truth;
    const section = sections[data.scenes.indexOf(scene)], stops = [...section.querySelectorAll("li")];
    $("count").textContent = `${step} of ${scene.stops.length}`;
    $("lowest").textContent = nats(now.low);
    $("highest").textContent = nats(now.high);
    $("picture").src = stops[step - 1].querySelector("img").src;
    $("picture").alt = stops[step - 1].querySelector("img").alt;
    stops.forEach((item, i) => (i === step - 1 ? item.setAttribute("aria-current", "step") : item.removeAttribute("aria-current")));
    const next = now.following < 0 ? "This is the last view." :
      `Next is view ${now.following}: its expected gain of ${nats(now.gains[now.following])} is the highest of ${now.left.length}.`;
    const answer = `${data.classes[label]} with ${percent(p)}, which is ${right ? "right ✓" : `wrong ✗: it is a ${data.classes[scene.truth]}`}`;
    $("said").textContent = `View ${stop.view}, number ${step} of ${scene.stops.length}. The answer would be ${answer}. ${next}`;
    $("bars").replaceChildren(...stop.bars.map(([of, share]) => {
      const [item, name, bar, fill, value] = ["li", "span", "span", "span", "b"].map((tag) => document.createElement(tag));
      name.textContent = data.classes[of] + (of === scene.truth ? " (true)" : "");
      bar.className = "bar";
      fill.style.width = `${100 * share}%`;
      value.textContent = percent(share);
      bar.append(fill);
      item.append(name, bar, value);
      return item;
    }));
    canvas.setAttribute("aria-label", `3-D scene of ${scene.name}. Views seen, in order: ${now.seen.join(", ")}. ` +
      `${now.left.length} candidate views are left, with expected gains from ${nats(now.low)} to ${nats(now.high)}.`);
  };
  const show = (wanted) => {
    step = Math.max(1, Math.min(scene.stops.length, wanted));
    $("step").value = step;
    $("step").setAttribute("aria-valuetext", `${step} of ${scene.stops.length}`);
    tell();
    redraw();
  };
  const choose = (index) => {
    scene = data.scenes[index];
    $("step").max = scene.stops.length;
    sections.forEach((section, i) => (section.hidden = i !== index));
    show(1);
  };

  // Mouse, finger, keys, buttons.
  const turn = (azimuth, elevation, zoom = 1) => {
    eye.azimuth += azimuth;
    eye.elevation = Math.max(-1.5, Math.min(1.5, eye.elevation + elevation));
    eye.zoom = Math.max(0.5, Math.min(4, eye.zoom * zoom));
    redraw();
  };
  const actions = {
    left: () => turn(0.2, 0), right: () => turn(-0.2, 0), up: () => turn(0, 0.15), down: () => turn(0, -0.15), in: () => turn(0, 0, 1.2),
    out: () => turn(0, 0, 1 / 1.2), reset: () => (Object.assign(eye, START), redraw()), back: () => show(step - 1), next: () => show(step + 1),
  };
  const keys = { ArrowLeft: "left", ArrowRight: "right", ArrowUp: "up", ArrowDown: "down", "+": "in", "=": "in", "-": "out", Home: "reset" };
  const fingers = new Map();
  const apart = () => {
    const [a, b] = [...fingers.values()];
    return Math.hypot(a.x - b.x, a.y - b.y);
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  canvas.addEventListener("pointermove", (event) => {
    const from = fingers.get(event.pointerId), before = fingers.size === 2 ? apart() : 0;
    if (!from) return;
    fingers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (before) turn(0, 0, apart() / before);
    else turn((from.x - event.clientX) * 0.01, (event.clientY - from.y) * 0.01);
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
  canvas.addEventListener("wheel", (event) => {
    if (document.activeElement !== canvas && !event.ctrlKey) return; // else the page scrolls
    event.preventDefault();
    turn(0, 0, Math.exp(-event.deltaY * 0.002));
  }, { passive: false });
  canvas.addEventListener("keydown", (event) => {
    if (!keys[event.key] || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    actions[keys[event.key]]();
  });
  document.querySelectorAll("#viewer [data-do]").forEach((button) => button.addEventListener("click", actions[button.dataset.do]));
  $("step").addEventListener("input", () => show(Number($("step").value)));
  $("object").append(...data.scenes.map((of, i) => new Option(of.name, i)));
  $("object").addEventListener("change", () => choose(Number($("object").value)));
  addEventListener("resize", redraw);
  matchMedia("(prefers-color-scheme:dark)").addEventListener("change", () => (readColours(), redraw()));
  readColours();
  $("viewer").hidden = false;
  choose(0);
})();

(function () {
  "use strict";
  const scene = JSON.parse(document.getElementById("scene").textContent);
  const canvas = document.getElementById("view"), names = document.getElementById("names");
  const along = document.getElementById("along"), place = document.getElementById("place");
  const cut = document.getElementById("cut"), trouble = document.getElementById("trouble");
  const FIELD = 50 * Math.PI / 180, NEAR = 0.1, FAR = 5000;
  const gl = canvas.getContext("webgl", {antialias: true});
  function say(words) { trouble.textContent = words; trouble.hidden = false; }
  if (!gl) {
    canvas.style.display = "none";
    say("This browser draws no WebGL: the picture from above is below.");
    return;
  }

  // --- what is drawn
  const VERTEX = `
    attribute vec3 steps;
    uniform vec3 shift; uniform float step_m, size, pixels, cut, shade; uniform mat4 turn, lens;
    varying float light;
    void main() {
      vec3 here = steps * step_m + shift;
      vec4 seen = turn * vec4(here, 1.0);
      gl_Position = lens * seen;
      if (shade < 0.5) { // objects in front of the map points among them
        vec4 nearer = lens * vec4(seen.xy, seen.z + 0.08, 1.0);
        if (nearer.w > 0.1) gl_Position.z = nearer.z / nearer.w * gl_Position.w;
      }
      gl_PointSize = clamp(size * pixels / max(gl_Position.w, 0.1), 1.5, 60.0);
      light = mix(1.0, 0.72 + 0.28 * smoothstep(-2.0, 3.0, here.z), shade);
      if (cut > 0.0 && length(here) > cut) gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
    }`;
  const FRAGMENT = `
    precision mediump float;
    uniform vec3 rgb; uniform float round; varying float light;
    void main() {
      if (round > 0.5 && length(gl_PointCoord - 0.5) > 0.5) discard;
      gl_FragColor = vec4(rgb * light, 1.0);
    }`;
  function compile(kind, text) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    return shader;
  }
  const at = {};
  function prepare() {
    const program = gl.createProgram();
    gl.attachShader(program, compile(gl.VERTEX_SHADER, VERTEX));
    gl.attachShader(program, compile(gl.FRAGMENT_SHADER, FRAGMENT));
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    gl.useProgram(program);
    ["shift", "step_m", "size", "pixels", "cut", "shade", "turn", "lens", "rgb", "round"].forEach(function (name) {
      at[name] = gl.getUniformLocation(program, name);
    });
    const packed = atob(document.getElementById("points").textContent), bytes = new Uint8Array(packed.length);
    for (let k = 0; k < packed.length; k++) bytes[k] = packed.charCodeAt(k);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, bytes, gl.STATIC_DRAW);
    const steps = gl.getAttribLocation(program, "steps");
    gl.enableVertexAttribArray(steps);
    gl.vertexAttribPointer(steps, 3, gl.UNSIGNED_SHORT, false, 6, 0);
    gl.enable(gl.DEPTH_TEST);
    gl.clearColor(1, 1, 1, 1);
  }
  try { prepare(); } catch (error) {
    say("This browser cannot draw the picture (" + error.message + "): the one from above is below.");
    return;
  }

  // --- the camera: it looks at a place from a distance, turned about the vertical and tilted
  const camera = {yaw: -2.36, tilt: 0.7, distance: 13, target: scene.path[scene.at].slice()};
  const hidden = {};
  function axes() {
    const c = Math.cos(camera.tilt), s = Math.sin(camera.tilt), cy = Math.cos(camera.yaw), sy = Math.sin(camera.yaw);
    // towards the eye; to the right; up in the picture
    return {eye: [c * cy, c * sy, s], right: [-sy, cy, 0], up: [-s * cy, -s * sy, c]};
  }
  function dot(a, b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
  function project(here, frame, width, height) {
    const from = [0, 1, 2].map(function (k) { return here[k] - camera.target[k]; });
    const depth = camera.distance - dot(from, frame.eye), scale = height / 2 / Math.tan(FIELD / 2);
    if (depth < NEAR) return null;
    return [width / 2 + scale * dot(from, frame.right) / depth, height / 2 - scale * dot(from, frame.up) / depth];
  }
  let waiting = false;
  function redraw() {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(function () { waiting = false; draw(); });
  }
  function draw() {
    const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
    const wide = Math.round(width * ratio), high = Math.round(height * ratio);
    if (canvas.width !== wide || canvas.height !== high) { canvas.width = wide; canvas.height = high; }
    gl.viewport(0, 0, wide, high);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const f = axes(), r = f.right, u = f.up, e = f.eye, focal = 1 / Math.tan(FIELD / 2);
    gl.uniformMatrix4fv(at.turn, false, [
      r[0], u[0], e[0], 0, r[1], u[1], e[1], 0, r[2], u[2], e[2], 0, 0, 0, -camera.distance, 1]);
    gl.uniformMatrix4fv(at.lens, false, [
      focal * height / width, 0, 0, 0, 0, focal, 0, 0,
      0, 0, (FAR + NEAR) / (NEAR - FAR), -1, 0, 0, 2 * FAR * NEAR / (NEAR - FAR), 0]);
    gl.uniform3fv(at.shift, scene.origin.map(function (low, k) { return low - camera.target[k]; }));
    gl.uniform1f(at.step_m, scene.step);
    gl.uniform1f(at.pixels, high * focal / 2);
    gl.uniform1f(at.cut, Number(cut.value));
    scene.layers.forEach(function (layer) {
      if (hidden[layer.group]) return;
      const dots = layer.kind === "points";
      gl.uniform3fv(at.rgb, layer.rgb);
      gl.uniform1f(at.size, layer.size);
      gl.uniform1f(at.round, dots ? 1 : 0);
      gl.uniform1f(at.shade, /^(map|roof) /.test(layer.group) ? 1 : 0);
      gl.drawArrays(dots ? gl.POINTS : gl.LINE_STRIP, layer.start, layer.n);
    });
    scene.names.forEach(function (label, k) {
      const on = hidden[label.group] ? null : project(label.at, f, width, height), span = names.children[k];
      span.hidden = on === null;
      if (on) span.style.transform = "translate(" + on[0].toFixed(1) + "px," + on[1].toFixed(1) + "px) translate(-50%,-100%)";
    });
  }

  // --- names, switches and the slider
  scene.names.forEach(function (label) {
    const span = document.createElement("span");
    span.textContent = label.text;
    names.append(span);
  });
  const groups = document.getElementById("groups"), known = {};
  scene.layers.forEach(function (layer) {
    if (known[layer.group]) return;
    known[layer.group] = true;
    hidden[layer.group] = !layer.shown;
    const label = document.createElement("label"), box = document.createElement("input"), dot = document.createElement("i");
    box.type = "checkbox";
    box.checked = layer.shown;
    box.addEventListener("change", function () { hidden[layer.group] = !box.checked; redraw(); });
    dot.style.background = "rgb(" + layer.rgb.map(function (part) { return Math.round(255 * part); }).join(",") + ")";
    label.append(box, dot, layer.group);
    groups.append(label);
  });
  function tell() {
    const k = Number(along.value), last = scene.chainage[scene.chainage.length - 1];
    place.textContent = scene.chainage[k].toFixed(1) + " m of " + last.toFixed(1) + " m" + (scene.near[k] ? "" : ", not seen");
  }
  function nearest(here) {
    let best = 0, least = Infinity;
    scene.path.forEach(function (each, k) {
      const far = Math.hypot(each[0] - here[0], each[1] - here[1], each[2] - here[2]);
      if (far < least) { least = far; best = k; }
    });
    return best;
  }
  function go(here) {
    camera.target = here.slice();
    along.value = nearest(here);
    tell();
    redraw();
  }
  along.max = scene.path.length - 1;
  along.value = scene.at;
  along.addEventListener("input", function () {
    camera.target = scene.path[Number(along.value)].slice();
    tell();
    redraw();
  });
  cut.addEventListener("change", redraw);
  document.getElementById("above").addEventListener("click", function () { camera.tilt = 1.5; redraw(); });
  document.getElementById("oblique").addEventListener("click", function () { camera.tilt = 0.7; redraw(); });
  document.querySelectorAll("#table-1 tbody tr").forEach(function (row) {
    const label = scene.names.find(function (each) { return each.text.split(" ")[0] === row.cells[0].textContent; });
    if (!label) return;
    row.className = "goes";
    row.tabIndex = 0;
    function show() { go(label.at); canvas.scrollIntoView({block: "nearest"}); }
    row.addEventListener("click", show);
    row.addEventListener("keydown", function (event) { if (event.key === "Enter") show(); });
  });

  // --- mouse, fingers and keys
  function zoom(factor) { camera.distance = Math.min(2000, Math.max(0.5, camera.distance * factor)); redraw(); }
  function turn(dx, dy) {
    camera.yaw -= 0.006 * dx;
    camera.tilt = Math.min(1.55, Math.max(-1.55, camera.tilt + 0.006 * dy));
    redraw();
  }
  function shift(dx, dy) {
    const f = axes(), metres = 2 * camera.distance * Math.tan(FIELD / 2) / canvas.clientHeight;
    camera.target = camera.target.map(function (each, k) { return each + metres * (dy * f.up[k] - dx * f.right[k]); });
    redraw();
  }
  const fingers = new Map();
  canvas.addEventListener("contextmenu", function (event) { event.preventDefault(); });
  canvas.addEventListener("pointerdown", function (event) {
    canvas.setPointerCapture(event.pointerId);
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
  });
  function apart() {
    const two = Array.from(fingers.values());
    return Math.hypot(two[0][0] - two[1][0], two[0][1] - two[1][1]);
  }
  canvas.addEventListener("pointermove", function (event) {
    const was = fingers.get(event.pointerId);
    if (!was) return;
    const before = fingers.size === 2 ? apart() : 0, dx = event.clientX - was[0], dy = event.clientY - was[1];
    fingers.set(event.pointerId, [event.clientX, event.clientY]);
    if (fingers.size === 2) { zoom(before / Math.max(apart(), 1)); shift(dx / 2, dy / 2); }
    else if (event.shiftKey || event.buttons & 6) shift(dx, dy);
    else turn(dx, dy);
  });
  ["pointerup", "pointercancel"].forEach(function (name) {
    canvas.addEventListener(name, function (event) { fingers.delete(event.pointerId); });
  });
  canvas.addEventListener("wheel", function (event) {
    event.preventDefault();
    zoom(Math.exp(0.0015 * event.deltaY));
  }, {passive: false});
  canvas.addEventListener("keydown", function (event) {
    const keys = {
      ArrowLeft: [turn, 20, 0], ArrowRight: [turn, -20, 0], ArrowUp: [turn, 0, 20], ArrowDown: [turn, 0, -20],
      "+": [zoom, 0.85], "-": [zoom, 1.18],
    };
    const found = keys[event.key];
    if (!found) return;
    event.preventDefault();
    found[0].apply(null, found.slice(1));
  });
  canvas.addEventListener("webglcontextrestored", function () { prepare(); redraw(); });
  canvas.addEventListener("webglcontextlost", function (event) { event.preventDefault(); });
  new ResizeObserver(redraw).observe(canvas);
  tell();
  draw();
})();

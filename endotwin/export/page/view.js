"use strict";
const told = name => document.getElementById(name).textContent;
const scene = JSON.parse(told("scene")), look = scene.appearance, lens = scene.lens;
const wish = new URLSearchParams(location.hash.slice(1));
if (wish.has("bare")) document.body.classList.add("bare");
const canvas = document.getElementById("view"), said = document.getElementById("said");
const gl = canvas.getContext("webgl2", {antialias: true, alpha: false});

// name: [words, least, most, step, value of the twin]
const SLIDERS = {
  along: ["path", 0, Math.max(scene.path.length - 1, 0), 0.01, 0],
  intensity: ["light ×", 0.1, 4, 0.01, 1],
  n: ["light n", 0, 8, 0.01, look.n],
  q: ["light q", 0, 4, 0.01, look.q],
  roughness: ["roughness ×", 0.2, 2.5, 0.01, 1],
  f0: ["highlight f0", 0, 0.2, 0.001, look.f0],
  coat_f0: ["coat f0", 0, 0.2, 0.001, look.coat_f0],
  exposure: ["exposure ×", 0.1, 4, 0.01, 1],
};
if (look.film_f0) SLIDERS.film_f0 = ["film f0", 0, 0.2, 0.001, look.film_f0];
const state = {film_f0: 0}, outputs = {};
const camera = {centre: [0, 0, 0], turn: [1, 0, 0, 0, 1, 0, 0, 0, 1]};  // turn: columns right, down, ahead
let uniform = null, count = 0, playing = false;

function sliders() {
  for (const [name, [words, low, high, step, value]] of Object.entries(SLIDERS)) {
    const label = document.createElement("label"), input = document.createElement("input");
    outputs[name] = document.createElement("output");
    Object.assign(input, {type: "range", min: low, max: Math.max(high, value), step, value});
    input.oninput = () => { set(name, +input.value); if (name === "along") follow(); draw(); };
    label.append(words, input, outputs[name]);
    document.getElementById("sliders").append(label);
    outputs[name].input = input;
    set(name, value);
  }
}

function set(name, value) {
  state[name] = value;
  outputs[name].textContent = name === "along" ? value.toFixed(1) : value.toFixed(3);
  outputs[name].input.value = value;
}

// Poses are position and quaternion (x, y, z, w); between two of them the shorter arc.
function follow() {
  if (!scene.path.length) return;
  const i = Math.min(Math.floor(state.along), scene.path.length - 1), j = Math.min(i + 1, scene.path.length - 1);
  const a = scene.path[i], b = scene.path[j], t = state.along - i;
  camera.centre = [0, 1, 2].map(k => a[k] + t * (b[k] - a[k]));
  const sign = [3, 4, 5, 6].reduce((sum, k) => sum + a[k] * b[k], 0) < 0 ? -1 : 1;
  const mixed = [3, 4, 5, 6].map(k => a[k] + t * (sign * b[k] - a[k])), size = Math.hypot(...mixed);
  const [x, y, z, w] = mixed.map(value => value / size);
  camera.turn = [1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w),
                 2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w),
                 2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)];
}

function column(i) { return camera.turn.slice(3 * i, 3 * i + 3); }
function move(axis, mm) { camera.centre = camera.centre.map((value, k) => value + mm * column(axis)[k]); }

// Turn the camera about its own axes: column i towards column j.
function rotate(i, j, angle) {
  const a = column(i), b = column(j), c = Math.cos(angle), s = Math.sin(angle);
  for (let k = 0; k < 3; k++) {
    camera.turn[3 * i + k] = c * a[k] + s * b[k];
    camera.turn[3 * j + k] = c * b[k] - s * a[k];
  }
}

function program() {
  const made = gl.createProgram();
  for (const [name, kind] of [["vertex", gl.VERTEX_SHADER], ["fragment", gl.FRAGMENT_SHADER]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, told(name).trim());
    gl.compileShader(shader);
    gl.attachShader(made, shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw Error(gl.getShaderInfoLog(shader));
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw Error(gl.getProgramInfoLog(made));
  gl.useProgram(made);
  return name => gl.getUniformLocation(made, name);
}

async function unpacked(text) {
  const bytes = Uint8Array.from(atob(text), letter => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).arrayBuffer();
}

async function load() {
  const content = await unpacked(told("mesh")), vertices = 16 * scene.vertices;
  uniform = program();
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, new Uint8Array(content, 0, vertices), gl.STATIC_DRAW);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, new Uint32Array(content, vertices, 3 * scene.triangles), gl.STATIC_DRAW);
  const layout = (stride, parts) => parts.forEach(([index, size, kind, offset]) => {
    gl.enableVertexAttribArray(index);
    gl.vertexAttribPointer(index, size, kind, true, stride, offset);
  });
  layout(16, [[0, 4, gl.UNSIGNED_SHORT, 0], [1, 2, gl.SHORT, 8], [2, 4, gl.UNSIGNED_BYTE, 12]]);
  const wet = new Uint8Array(content, vertices + 12 * scene.triangles);
  if (wet.length) {
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, wet, gl.STATIC_DRAW);
    layout(8, [[3, 2, gl.SHORT, 0], [4, 1, gl.FLOAT, 4]]);
  }
  count = 3 * scene.triangles;
  gl.enable(gl.DEPTH_TEST);
  gl.clearColor(0, 0, 0, 1);
}

function draw() {
  if (!count) return;
  const ratio = wish.has("bare") ? 1 : Math.min(devicePixelRatio || 1, 2);
  canvas.width = Math.round(innerWidth * ratio);
  canvas.height = Math.round(innerHeight * ratio);
  gl.viewport(0, 0, canvas.width, canvas.height);
  gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  const shrink = Math.min(canvas.width / lens.width, canvas.height / lens.height), set1 = (name, value) => gl.uniform1f(uniform(name), value);
  gl.uniform3fv(uniform("low"), scene.low);
  gl.uniform3fv(uniform("extent"), scene.extent);
  gl.uniform3fv(uniform("centre"), camera.centre);
  gl.uniformMatrix3fv(uniform("turn"), true, camera.turn);
  gl.uniform4f(uniform("lens"), 2 * lens.fx / lens.width, 2 * lens.fy / lens.height,
               (2 * lens.cx + 1) / lens.width - 1, (2 * lens.cy + 1) / lens.height - 1);
  gl.uniform2f(uniform("fit"), shrink * lens.width / canvas.width, shrink * lens.height / canvas.height);
  gl.uniform2f(uniform("range_mm"), 0.2, 1000);
  gl.uniform4f(uniform("image"), lens.fx, lens.fy, lens.cx, lens.cy);
  gl.uniform2f(uniform("size"), lens.width, lens.height);
  gl.uniform2f(uniform("vignetting"), look.vignetting_k2, look.vignetting_k4);
  gl.uniform3fv(uniform("guides_mm"), look.guides_mm.flat());
  gl.uniform1i(uniform("guides"), look.guides_mm.length);
  for (const name of ["n", "q", "roughness", "f0", "coat_f0", "film_f0", "exposure"]) set1(name, state[name]);
  // Another q keeps the brightness at the usual distance.
  set1("L0", look.L0 * state.intensity * look.usual_mm ** (state.q - look.q));
  set1("profile", look.profile);
  set1("gamma", look.gamma);
  set1("tone", look.tone);
  set1("burley", look.burley ? 1 : 0);
  set1("coat_roughness", look.coat_roughness || 0.12);
  set1("coat_tail", look.coat_tail);
  set1("film_roughness", look.film_roughness);
  gl.drawElements(gl.TRIANGLES, count, gl.UNSIGNED_INT, 0);
}

function controls() {
  const fingers = new Map(), TURN = 0.004, STEP_MM = 0.5;
  canvas.onpointerdown = event => { canvas.setPointerCapture(event.pointerId); fingers.set(event.pointerId, event); };
  canvas.onpointerup = canvas.onpointercancel = event => fingers.delete(event.pointerId);
  canvas.onpointermove = event => {
    const before = fingers.get(event.pointerId);
    if (!before) return;
    if (fingers.size === 1) {
      rotate(2, 0, TURN * (before.clientX - event.clientX));
      rotate(2, 1, TURN * (before.clientY - event.clientY));
    } else {
      const other = [...fingers.values()].find(finger => finger.pointerId !== event.pointerId);
      const apart = finger => Math.hypot(finger.clientX - other.clientX, finger.clientY - other.clientY);
      move(2, 0.05 * (apart(event) - apart(before)));
    }
    fingers.set(event.pointerId, event);
    draw();
  };
  canvas.onwheel = event => { event.preventDefault(); move(2, -0.01 * event.deltaY); draw(); };
  const KEYS = {
    w: () => move(2, STEP_MM), s: () => move(2, -STEP_MM), a: () => move(0, -STEP_MM), d: () => move(0, STEP_MM),
    r: () => move(1, -STEP_MM), f: () => move(1, STEP_MM), q: () => rotate(0, 1, -0.05), e: () => rotate(0, 1, 0.05),
  };
  onkeydown = event => { const act = KEYS[event.key.toLowerCase()]; if (act) { act(); draw(); } };
  onresize = draw;
  document.getElementById("reset").onclick = () => {
    for (const name of Object.keys(SLIDERS)) set(name, SLIDERS[name][4]);
    follow();
    draw();
  };
  document.getElementById("play").onclick = event => {
    playing = !playing;
    event.target.textContent = playing ? "stop" : "play";
    if (playing) requestAnimationFrame(fly);
  };
}

function fly() {
  if (!playing) return;
  set("along", (state.along + 0.1) % Math.max(scene.path.length - 1, 1));
  follow();
  draw();
  requestAnimationFrame(fly);
}

(async () => {
  try {
    if (!gl) throw Error("this browser has no WebGL 2");
    document.getElementById("panel").open = innerWidth > 700;
    sliders();
    controls();
    await load();
    if (wish.has("along")) set("along", +wish.get("along"));
    follow();
    draw();
    said.textContent = "";
    document.body.dataset.ready = "yes";
  } catch (error) {
    said.textContent = `The twin cannot be shown: ${error.message}.`;
  }
})();

// The page's viewer: an object that was trained, under maps that turn. THREE stands above.
// World axes have +Z up, three's +Y: (x, y, z) of the world is (x, z, -y) here.
"use strict";
(() => {
  const $ = (id) => document.getElementById(id);
  const say = (text) => {
    $("message").textContent = text;
    $("message").style.opacity = text ? 1 : 0;
  };
  const LAYERS = ["render", "albedo", "roughness", "metal", "normal"];
  const FIELD_OF_VIEW = 30; // degrees, of the shorter side
  const scene = JSON.parse($("scene").textContent);
  const state = { layer: "render", light: 0, turn: 0, exposure: 0, background: false };

  function bytes(base64) {
    const text = atob(base64);
    const out = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) out[i] = text.charCodeAt(i);
    return out;
  }

  let renderer;
  try {
    renderer = new THREE.WebGLRenderer({ canvas: $("view"), antialias: true, alpha: true });
  } catch {
    say("This browser has no WebGL 2, which the page needs to draw the object.");
    return;
  }
  renderer.toneMapping = THREE.NoToneMapping; // sRGB, clipped at 1, as the program's PNG files
  const world = new THREE.Scene();
  const camera = new THREE.PerspectiveCamera(FIELD_OF_VIEW, 1, 0.1, 100);
  const orbit = new THREE.OrbitControls(camera, renderer.domElement);
  orbit.enableDamping = !matchMedia("(prefers-reduced-motion: reduce)").matches;
  orbit.dampingFactor = 0.12;
  const prefilter = new THREE.PMREMGenerator(renderer);

  // -- Light: a map, what three's filter makes of it, and its harmonics for the diffuse part

  const lights = scene.lights.map((map) => {
    const half = new Uint16Array(bytes(map.texels).buffer);
    const width = 2 * map.height;
    const texels = new Uint16Array(4 * width * map.height);
    for (let row = 0; row < map.height; row++)
      for (let column = 0; column < width; column++) {
        const from = 3 * (row * width + column);
        const to = 4 * ((map.height - 1 - row) * width + column); // textures begin at the bottom
        texels.set(half.subarray(from, from + 3), to);
        texels[to + 3] = 0x3c00; // 1
      }
    const texture = new THREE.DataTexture(
      texels, width, map.height, THREE.RGBAFormat, THREE.HalfFloatType,
      THREE.EquirectangularReflectionMapping, THREE.RepeatWrapping, THREE.ClampToEdgeWrapping,
      THREE.LinearFilter, THREE.LinearFilter,
    );
    texture.needsUpdate = true;
    return { ...map, half, width, texture, filtered: null };
  });

  function filtered(light) {
    light.filtered ??= prefilter.fromEquirectangular(light.texture).texture;
    return light.filtered;
  }

  // Numbers of the map turned counter-clockwise about the world's +Z: l, m stands at l^2 + l + m.
  function turned(harmonics, angle, factor) {
    const out = [];
    for (let l = 0, k = 0; k < harmonics.length; l++)
      for (let m = -l; m <= l; m++, k++) {
        const other = harmonics[l * l + l - m];
        const c = Math.cos(m * angle), s = Math.sin(m * angle);
        out.push(new THREE.Vector3(...harmonics[k].map((x, i) => factor * (c * x - s * other[i]))));
      }
    return out;
  }

  // -- Material: the program's BRDF; diffuse light through what each vertex sees past the object

  const uniforms = { layer: { value: 0 }, mapNumbers: { value: turned(lights[0].harmonics, 0, 1) } };
  const GROUPS = 7; // of four attributes: 25 numbers and three 0
  const VERTEX = `
    uniform vec3 mapNumbers[25];
    ${[...Array(GROUPS).keys()].map((i) => `attribute vec4 _direct${i};`).join("\n")}
    attribute vec4 _red, _green, _blue;
    varying vec3 vLit;
    varying vec3 vBounced;
    varying float vOpen;
  `;
  const LIT = `
    vLit = vec3(0.0);
    ${[...Array(25).keys()].map((i) => `vLit += mapNumbers[${i}] * _direct${i >> 2}[${i & 3}];`).join("\n")}
    vBounced.r = dot(vec4(mapNumbers[0].r, mapNumbers[1].r, mapNumbers[2].r, mapNumbers[3].r), _red);
    vBounced.g = dot(vec4(mapNumbers[0].g, mapNumbers[1].g, mapNumbers[2].g, mapNumbers[3].g), _green);
    vBounced.b = dot(vec4(mapNumbers[0].b, mapNumbers[1].b, mapNumbers[2].b, mapNumbers[3].b), _blue);
    vOpen = clamp(_direct0[0] / 0.282095, 0.0, 1.0);
  `;
  const FRAGMENT = `
    uniform int layer;
    uniform vec3 mapNumbers[25];
    varying vec3 vLit;
    varying vec3 vBounced;
    varying float vOpen;
    vec3 inWorld(vec3 n) {
      vec3 w = transformNormalByInverseViewMatrix(n, viewMatrix);
      return vec3(w.x, -w.z, w.y);
    }
    // Irradiance over pi of the whole map: Ramamoorthi and Hanrahan 2001
    vec3 unshadowed(vec3 n) {
      vec3 e = 0.282095 * mapNumbers[0];
      e += 0.325735 * (n.y * mapNumbers[1] + n.z * mapNumbers[2] + n.x * mapNumbers[3]);
      e += 0.273137 * (n.x * n.y * mapNumbers[4] + n.y * n.z * mapNumbers[5] + n.x * n.z * mapNumbers[7]);
      e += 0.078848 * (3.0 * n.z * n.z - 1.0) * mapNumbers[6];
      e += 0.136569 * (n.x * n.x - n.y * n.y) * mapNumbers[8];
      return max(e, vec3(1e-4 * mapNumbers[0]));
    }
  `;
  const SHADE = `
    vec3 relief = unshadowed(inWorld(normal)) / max(unshadowed(inWorld(nonPerturbedNormal)), vec3(1e-6));
    vec3 lit = max(vLit, vec3(0.0)) * clamp(relief, 0.0, 4.0) + max(vBounced, vec3(0.0));
    reflectedLight.indirectDiffuse = material.diffuseContribution * lit;
    vec3 f0 = mix(vec3(0.04), diffuseColor.rgb, metalnessFactor);
    float facing = saturate(dot(normal, geometryViewDir));
    float open = computeSpecularOcclusion(facing, vOpen, material.roughness);
    vec3 mirrored = mix(diffuseColor.rgb * lit, radiance, open);
    reflectedLight.indirectSpecular = mirrored * (f0 * material.dfg.x + material.dfg.y);
  `;
  const SHOWN = `
    if (layer == 1) gl_FragColor.rgb = sRGBTransferOETF(vec4(diffuseColor.rgb, 1.0)).rgb;
    if (layer == 2) gl_FragColor.rgb = vec3(roughnessFactor);
    if (layer == 3) gl_FragColor.rgb = vec3(metalnessFactor);
    if (layer == 4) gl_FragColor.rgb = 0.5 * inWorld(normal) + 0.5;
  `;

  function patch(shader) {
    Object.assign(shader.uniforms, uniforms);
    shader.vertexShader = shader.vertexShader
      .replace("#include <common>", `#include <common>\n${VERTEX}`)
      .replace("#include <begin_vertex>", `#include <begin_vertex>\n${LIT}`);
    shader.fragmentShader = shader.fragmentShader
      .replace("#include <lights_pars_begin>", `#include <lights_pars_begin>\n${FRAGMENT}`)
      .replace("#include <lights_fragment_end>", SHADE)
      .replace("#include <colorspace_fragment>", `#include <colorspace_fragment>\n${SHOWN}`);
  }

  // -- The picture

  let wanted = false;
  function draw() {
    if (wanted) return;
    wanted = true;
    requestAnimationFrame(() => {
      wanted = false;
      if (orbit.update()) draw(); // still gliding
      renderer.render(world, camera);
    });
  }
  orbit.addEventListener("change", draw);

  function show() {
    const light = lights[state.light];
    const factor = 2 ** state.exposure, angle = (state.turn * Math.PI) / 180;
    const turn = new THREE.Euler(0, angle, 0);
    uniforms.layer.value = LAYERS.indexOf(state.layer);
    uniforms.mapNumbers.value = turned(light.harmonics, angle, factor);
    world.environment = filtered(light);
    world.environmentIntensity = world.backgroundIntensity = factor;
    world.environmentRotation.copy(turn);
    world.backgroundRotation.copy(turn);
    world.background = state.background && state.layer === "render" ? light.texture : null;
    draw();
  }

  const ball = new THREE.Sphere(new THREE.Vector3(), 1);
  function look() {
    const [azimuth, elevation] = scene.view.map((degrees) => (degrees * Math.PI) / 180);
    const across = Math.cos(elevation);
    const back = [across * Math.cos(azimuth), Math.sin(elevation), -across * Math.sin(azimuth)];
    const room = innerWidth < 640 ? 1.0 : 1.12; // for the dock
    const distance = (room * ball.radius) / Math.sin((FIELD_OF_VIEW * Math.PI) / 360);
    orbit.target.copy(ball.center);
    camera.position.copy(ball.center).addScaledVector(new THREE.Vector3(...back), distance);
    orbit.minDistance = 0.3 * ball.radius;
    orbit.maxDistance = 4 * distance;
    draw();
  }

  function resize() {
    const width = innerWidth, height = innerHeight;
    renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    renderer.setSize(width, height, false);
    const half = Math.tan((FIELD_OF_VIEW * Math.PI) / 360);
    camera.aspect = width / height;
    camera.fov = (360 / Math.PI) * Math.atan(half * Math.max(1, height / width));
    // The object stands in the middle of what the dock leaves free
    const dock = $("dock").getBoundingClientRect();
    const hidden = Math.max(0, height - dock.top - 10);
    camera.setViewOffset(width, height, 0, 0.5 * hidden * 0.8, width, height);
    camera.updateProjectionMatrix();
    draw();
  }

  // A picture of given size from a given camera, or of the present view: a PNG as a data URL.
  function picture(size, matrix, projection) {
    const [eye, ratio] = [camera, renderer.getPixelRatio()];
    const own = eye.clone();
    if (matrix) {
      own.matrixAutoUpdate = false;
      own.matrix.fromArray(matrix);
      own.updateMatrixWorld(true);
      own.clearViewOffset();
      own.projectionMatrix.fromArray(projection);
      own.projectionMatrixInverse.copy(own.projectionMatrix).invert();
    }
    if (size) {
      renderer.setPixelRatio(1);
      renderer.setSize(...size, false);
    }
    renderer.render(world, own);
    const url = renderer.domElement.toDataURL("image/png");
    if (size) {
      renderer.setPixelRatio(ratio);
      resize();
    }
    draw();
    return url;
  }

  // -- Controls

  function set(change) {
    Object.assign(state, change);
    const wrapped = ((((state.turn + 180) % 360) + 360) % 360) - 180;
    state.turn = wrapped === -180 && change.turn > 0 ? 180 : wrapped;
    for (const button of $("layers").children)
      button.setAttribute("aria-checked", button.dataset.name === state.layer);
    [...$("lights").children].forEach((button, i) => button.setAttribute("aria-checked", i === state.light));
    $("turn").value = state.turn;
    $("turn-value").textContent = `${Math.round(state.turn)}\u00b0`;
    $("exposure").value = state.exposure;
    $("exposure-value").textContent = `${state.exposure > 0 ? "+" : ""}${state.exposure.toFixed(1)} EV`;
    $("background").setAttribute("aria-pressed", state.background);
    $("dock").classList.toggle("plain", state.layer !== "render");
    show();
  }

  function choices(parent, names, choose, draw) {
    names.forEach((name, i) => {
      const button = document.createElement("button");
      button.setAttribute("role", "radio");
      button.dataset.name = name;
      if (draw) button.append(draw(i));
      button.append(name);
      button.addEventListener("click", () => choose(i));
      parent.append(button);
    });
  }

  function thumbnail(index) {
    const { half, width, height } = lights[index];
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [136, 68];
    const pen = canvas.getContext("2d");
    const image = pen.createImageData(136, 68);
    const values = Float32Array.from(half, THREE.DataUtils.fromHalfFloat);
    const bright = Float32Array.from(values).sort()[Math.floor(0.9 * values.length)];
    for (let y = 0; y < 68; y++)
      for (let x = 0; x < 136; x++) {
        const at = 3 * (Math.floor((y / 68) * height) * width + Math.floor((x / 136) * width));
        for (let c = 0; c < 3; c++) {
          const value = Math.min(1, (0.8 * values[at + c]) / Math.max(bright, 1e-6));
          image.data[4 * (136 * y + x) + c] = 255 * value ** (1 / 2.2);
        }
        image.data[4 * (136 * y + x) + 3] = 255;
      }
    pen.putImageData(image, 0, 0);
    return canvas;
  }

  let grabbing = false;
  function grab(on) {
    grabbing = on;
    $("grab").setAttribute("aria-pressed", on);
    renderer.domElement.classList.toggle("light", on);
  }

  let spinning = 0;
  function spin(now) {
    if (!spinning) return;
    set({ turn: state.turn + 0.03 * Math.min(now - spinning, 100) });
    spinning = now;
    requestAnimationFrame(spin);
  }
  function toggleSpin() {
    spinning = spinning ? 0 : performance.now();
    $("spin").setAttribute("aria-pressed", !!spinning);
    if (spinning) requestAnimationFrame(spin);
  }

  function save() {
    const link = document.createElement("a");
    link.href = picture();
    link.download = `${document.title}.png`;
    link.click();
  }

  function about(open) {
    $("panel").hidden = !open;
    $("about").setAttribute("aria-expanded", open);
  }

  // Dragging with Shift, or while the switch is on, turns the light; the orbit never hears of it.
  function listenToDrags(canvas) {
    let from = null;
    canvas.addEventListener("pointerdown", (event) => {
      $("hint").style.opacity = 0;
      about(false);
      if (event.button !== 0 || !(grabbing || event.shiftKey) || !event.isPrimary) return;
      event.stopImmediatePropagation();
      canvas.setPointerCapture(event.pointerId);
      from = { x: event.clientX, turn: state.turn };
    }, true);
    canvas.addEventListener("pointermove", (event) => {
      if (!from || !event.isPrimary) return;
      event.stopImmediatePropagation();
      set({ turn: from.turn + (300 * (event.clientX - from.x)) / innerWidth });
    }, true);
    for (const end of ["pointerup", "pointercancel"])
      canvas.addEventListener(end, () => { from = null; }, true);
  }

  function listen() {
    $("turn").addEventListener("input", (event) => set({ turn: +event.target.value }));
    $("exposure").addEventListener("input", (event) => set({ exposure: +event.target.value }));
    $("turn").addEventListener("dblclick", () => set({ turn: 0 }));
    $("exposure").addEventListener("dblclick", () => set({ exposure: 0 }));
    const actions = {
      background: () => set({ background: !state.background }),
      grab: () => grab(!grabbing),
      spin: toggleSpin,
      save,
      reset: () => { set({ turn: 0, exposure: 0 }); look(); },
      about: () => about($("panel").hidden),
      close: () => about(false),
    };
    for (const [id, action] of Object.entries(actions)) $(id).addEventListener("click", action);
    const keys = { b: "background", l: "grab", s: "save", 0: "reset", i: "about", " ": "spin", Escape: "close" };
    addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      const inside = event.target.closest("button, input");
      if (inside && [" ", "Enter", "ArrowLeft", "ArrowRight"].includes(event.key)) return;
      if (keys[event.key]) actions[keys[event.key]]();
      else if (LAYERS[event.key - 1]) set({ layer: LAYERS[event.key - 1] });
      else if (event.key === "ArrowLeft") set({ turn: state.turn - 5 });
      else if (event.key === "ArrowRight") set({ turn: state.turn + 5 });
      else return;
      event.preventDefault();
    });
    listenToDrags(renderer.domElement);
    addEventListener("resize", resize);
  }

  async function start() {
    const { scene: model } = await new THREE.GLTFLoader().parseAsync(bytes($("model").textContent).buffer, "");
    model.traverse((part) => {
      if (!part.isMesh) return;
      part.material.onBeforeCompile = patch;
      part.geometry.computeBoundingSphere();
      ball.copy(part.geometry.boundingSphere);
      for (const name of ["map", "roughnessMap", "metalnessMap", "normalMap"])
        if (part.material[name]) part.material[name].anisotropy = 8;
    });
    world.add(model);
    camera.near = 0.02 * ball.radius;
    camera.far = 60 * ball.radius;
    choices($("layers"), LAYERS, (i) => set({ layer: LAYERS[i] }));
    choices($("lights"), lights.map((light) => light.name), (i) => set({ light: i }), thumbnail);
    $("hint").textContent = matchMedia("(pointer: coarse)").matches
      ? "One finger orbits, two zoom"
      : "Drag to orbit, scroll to zoom, Shift-drag to turn the light";
    listen();
    resize();
    look();
    set({});
    await renderer.compileAsync(world, camera);
    say("");
  }

  const ready = start();
  ready.catch((error) => say(`The object could not be shown: ${error.message}`));
  window.univoxel = {
    ready, set, picture, state, layers: LAYERS, lights: lights.map((light) => light.name),
    eye: () => camera.position.toArray(),
  };
})();

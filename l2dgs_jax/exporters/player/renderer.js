// Draws the tracks as the rasterizer of l2dgs_jax does, but back to front, with premultiplied alpha.

const TEXELS = 2048; // in a row of a texture; every WebGL 2 device allows as many

function createRenderer(canvas, scene) {
  const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, powerPreference: "high-performance" });
  if (!gl) throw new Error("This browser offers no WebGL 2, which the scene is drawn with.");
  // In a framebuffer of bytes, colours would be rounded again with every Gaussian that is blended.
  const halfFloats = gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float");
  const splats = program(gl, "splat-vertex-shader", "splat-fragment-shader");
  const screen = program(gl, "screen-vertex-shader", "screen-fragment-shader");
  const units = ["positions", "quats", "shapes"];
  const bands = [
    [gl.RGB16UI, gl.RGB_INTEGER, gl.UNSIGNED_SHORT, 3],
    [gl.RGBA8_SNORM, gl.RGBA, gl.BYTE, 4],
    [gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, 4],
  ];
  units.forEach((name, unit) => {
    gl.activeTexture(gl.TEXTURE0 + unit);
    table(gl, scene[name], ...bands[unit]);
  });
  gl.activeTexture(gl.TEXTURE0 + units.length);
  const colors = scene.colors.map((rows) => table(gl, rows, gl.RGB8, gl.RGB, gl.UNSIGNED_BYTE, 3));

  const blended = gl.createFramebuffer();
  const order = gl.createBuffer();
  const corners = gl.createVertexArray();
  gl.bindVertexArray(corners);
  gl.bindBuffer(gl.ARRAY_BUFFER, order);
  gl.enableVertexAttribArray(0);
  gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
  gl.vertexAttribDivisor(0, 1);
  let count = 0;
  let target = null;

  function resize(width, height) {
    [canvas.width, canvas.height] = [width, height];
    gl.deleteTexture(target);
    gl.activeTexture(gl.TEXTURE0 + units.length + 1);
    target = texture(gl);
    gl.texStorage2D(gl.TEXTURE_2D, 1, halfFloats ? gl.RGBA16F : gl.RGBA8, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, blended);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, target, 0);
  }

  function arrange(sorted) {
    gl.bindBuffer(gl.ARRAY_BUFFER, order);
    gl.bufferData(gl.ARRAY_BUFFER, sorted, gl.STREAM_DRAW);
    count = sorted.length;
  }

  // `lens` has focal, principal and dilation in pixels of the canvas; `image` is the index of the set of colours.
  function draw(view, lens, { key, part }, image) {
    const at = splats.uniforms;
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, blended);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(splats.program);
    units.forEach((name, unit) => gl.uniform1i(at[name], unit));
    gl.uniform1i(at.colors, units.length);
    gl.activeTexture(gl.TEXTURE0 + units.length);
    gl.bindTexture(gl.TEXTURE_2D, colors[image]);
    gl.uniform1i(at.still, scene.still);
    gl.uniform1i(at.moving, scene.moving);
    gl.uniform1i(at.key, key);
    gl.uniform1f(at.part, part);
    gl.uniform3fv(at.boxLow, scene.box[0]);
    gl.uniform3fv(at.boxSize, scene.box[1].map((high, i) => high - scene.box[0][i]));
    gl.uniform2f(at.logScales, scene.logScales[0], scene.logScales[1] - scene.logScales[0]);
    gl.uniformMatrix3fv(at.rotation, true, view.axes.flat());
    gl.uniform3fv(at.translation, view.translation);
    gl.uniform2fv(at.focal, lens.focal);
    gl.uniform2fv(at.principal, lens.principal);
    gl.uniform2f(at.size, canvas.width, canvas.height);
    for (const name of ["brightest", "nearPlane", "fieldMargin", "minAlpha", "maxAlpha"]) {
      gl.uniform1f(at[name], scene[name]);
    }
    gl.uniform1f(at.dilation, lens.dilation);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(corners);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, count);

    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.disable(gl.BLEND);
    gl.useProgram(screen.program);
    gl.uniform1i(screen.uniforms.blended, units.length + 1);
    gl.uniform1f(screen.uniforms.background, scene.background);
    gl.bindVertexArray(null);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  return { resize, arrange, draw };
}

function program(gl, ...sources) {
  const linked = gl.createProgram();
  [gl.VERTEX_SHADER, gl.FRAGMENT_SHADER].forEach((type, i) => {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, document.getElementById(sources[i]).textContent.trim());
    gl.compileShader(shader);
    gl.attachShader(linked, shader);
  });
  gl.linkProgram(linked);
  if (!gl.getProgramParameter(linked, gl.LINK_STATUS) && !gl.isContextLost()) {
    const logs = gl.getAttachedShaders(linked).map((shader) => gl.getShaderInfoLog(shader));
    throw new Error(`This browser cannot compile the shaders. ${logs.join("")}${gl.getProgramInfoLog(linked)}`);
  }
  const uniforms = {};
  for (let i = 0; i < gl.getProgramParameter(linked, gl.ACTIVE_UNIFORMS); i++) {
    const { name } = gl.getActiveUniform(linked, i);
    uniforms[name] = gl.getUniformLocation(linked, name);
  }
  return { program: linked, uniforms };
}

// An array as a texture: each of its rows is one texel, and texels fill the texture line by line.
function table(gl, rows, internal, format, type, channels) {
  const count = rows.length / channels;
  const lines = Math.floor(count / TEXELS);
  const most = gl.getParameter(gl.MAX_TEXTURE_SIZE);
  if (lines >= most) throw new Error("The scene is too large for this device's graphics.");
  const result = texture(gl);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  gl.texStorage2D(gl.TEXTURE_2D, 1, internal, TEXELS, lines + 1);
  gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, TEXELS, lines, format, type, rows);
  const rest = rows.subarray(lines * TEXELS * channels);
  gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, lines, count % TEXELS, 1, format, type, rest);
  return result;
}

function texture(gl) {
  const made = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, made);
  for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) {
    gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
  }
  return made;
}

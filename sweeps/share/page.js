"use strict";
// A map over a copy of a store, and the motions of pinned cells. All data is in the page.
(async () => {
  const { INK, breakable, element, line_of, tick } = drawing;
  const $ = (id) => document.getElementById(id);
  const about = JSON.parse($("about").textContent);
  const metrics = new Map(about.metrics.map((one) => [one.name, one]));
  const dims = new Map(about.dims.map((one) => [one.name, one]));
  const DOUBT = 128; // of a code
  const MARKS = { circle: "●", triangle: "▲", square: "■", diamond: "◆" };
  const MOST_SIDES = 20000; // of a border; more are the noise of cells that differ from all neighbours
  const view = { ...about.start, cell: null };

  // ---- data: base64 of deflated bytes, all first bytes of the numbers, all second ones, ...

  const bytes_of = async (id) => {
    const text = atob($(id).textContent);
    const packed = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i += 1) packed[i] = text.charCodeAt(i);
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
    $(id).remove();
    return new Uint8Array(await new Response(stream).arrayBuffer());
  };
  const floats_of = async (id) => {
    const planes = await bytes_of(id);
    const n = planes.length / 4;
    const bytes = new Uint8Array(planes.length);
    for (let plane = 0; plane < 4; plane += 1)
      for (let i = 0; i < n; i += 1) bytes[4 * i + plane] = planes[plane * n + i];
    return new Float32Array(bytes.buffer);
  };
  const unpack = async (metric) => {
    metric.codes = await bytes_of(`codes-${metric.name}`);
    metric.values = await floats_of(`values-${metric.name}`);
  };
  const load = (metric) => (metric.loading ||= unpack(metric));

  // ---- cells

  let stride = 1;
  for (const dim of [...about.dims].reverse()) {
    dim.stride = stride;
    stride *= dim.texts.length;
  }
  const offset = (view_, x, y) => {
    let found = 0;
    for (const dim of about.dims)
      found += dim.stride * (dim.name === view_.x ? x : dim.name === view_.y ? y : view_.at[dim.name]);
    return found;
  };
  const cell_at = (edges, place) => {
    let low = 0;
    let high = edges.length - 2;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (edges[middle] <= place) low = middle;
      else high = middle - 1;
    }
    return low;
  };
  const part_of = (metric, value) =>
    metric.log
      ? Math.log(Math.max(value, metric.low) / metric.low) / Math.log(metric.high / metric.low)
      : (value - metric.low) / (metric.high - metric.low);

  // ---- words

  // labels of dimensions have tags of the program; all other text is text
  const labelled = (dim) => element("span", { html: dim.label });
  const written = (value) => drawing.written(value, about.digits);
  const percent = (part) =>
    (part > 0 && part < 0.001 ? "<0.1" : part < 0.0995 && part > 0 ? (100 * part).toFixed(1)
      : part < 1 && part >= 0.995 ? ">99" : (100 * part).toFixed(0)) + "\u00a0%";

  // ---- the map

  const canvas = $("map").querySelector("canvas");
  const hatches = { // whether a pixel of a hatch is ink; lengths are those of the page
    dot: (u, v) => u % 6 < 1.6 && v % 6 < 1.6,
    cross: (u, v) => (u + v) % 8 < 1.3 || (u - v + 8000) % 8 < 1.3,
    horizontal_line: (u, v) => v % 6 < 1.4,
    right_diagonal_line: (u, v) => (u + v) % 8 < 1.6,
    vertical_line: (u) => u % 6 < 1.4,
    cross_hatch: (u, v) => u % 6 < 1.3 || v % 6 < 1.3,
  };
  const word = (colour) => { // #rrggbb as a pixel
    const [r, g, b] = [1, 3, 5].map((i) => parseInt(colour.slice(i, i + 2), 16));
    return (255 << 24 | b << 16 | g << 8 | r) >>> 0;
  };
  const looks = about.reasons.map((reason) => {
    const look = about.looks[reason];
    return look && { face: word(look[0]), ink: word(look[1]), inked: hatches[look[2]] };
  });
  const WHITE = word("#ffffff");
  const BLACK = word("#000000");
  // a dark line within a light one is seen on every colour
  const doubted = (u, v, colour) => {
    const at = (u - v + 9000) % 9;
    return at > 3 ? colour : at > 0.9 && at < 2.1 ? BLACK : WHITE;
  };

  const draw = () => {
    const metric = metrics.get(view.metric);
    const [x, y] = [dims.get(view.x), dims.get(view.y)];
    const ratio = window.devicePixelRatio || 1;
    const width = Math.max(1, Math.round(canvas.clientWidth * ratio));
    const height = Math.max(1, Math.round(canvas.clientHeight * ratio));
    canvas.width = width;
    canvas.height = height;
    const context = canvas.getContext("2d");
    const image = context.createImageData(width, height);
    const pixels = new Uint32Array(image.data.buffer);
    const palette = about.palettes[metric.palette];
    const nx = x.texts.length;
    const ny = y.texts.length;
    const start = offset(view, 0, 0);
    const colours = new Uint32Array(nx * ny);
    const codes = new Uint8Array(nx * ny);
    for (let j = 0; j < ny; j += 1)
      for (let i = 0; i < nx; i += 1) {
        const k = start + i * x.stride + j * y.stride;
        codes[j * nx + i] = metric.codes[k];
        const part = part_of(metric, metric.values[k]);
        colours[j * nx + i] = palette[Math.min(Math.max(Math.floor(256 * part), 0), 255) || 0];
      }
    const columns = Uint32Array.from({ length: width }, (_, i) => cell_at(x.edges, (i + 0.5) / width));
    for (let v = 0; v < height; v += 1) {
      const row = nx * cell_at(y.edges, 1 - (v + 0.5) / height);
      for (let u = 0; u < width; u += 1) {
        const k = row + columns[u];
        const look = looks[codes[k] & ~DOUBT];
        let colour = colours[k];
        if (look) colour = look.inked(u / ratio, v / ratio) ? look.ink : look.face;
        if (codes[k] & DOUBT) colour = doubted(u / ratio, v / ratio, colour);
        pixels[v * width + u] = colour;
      }
    }
    context.putImageData(image, 0, 0);
    context.scale(width, height);
    const inside = draw_border(context, x, y, start, codes, ratio / Math.sqrt(width * height));
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    draw_marks(context, x, y);
    say(metric, x, y, codes, inside);
  };

  // the line around the cells that converge; returns their share, or null
  const draw_border = (context, x, y, start, codes, pixel) => {
    if (!about.converged) return null;
    const [nx, ny] = [x.texts.length, y.texts.length];
    const inside = (i, j) => about.convergent[start + i * x.stride + j * y.stride];
    const infinite = about.reasons.indexOf("infinite");
    const known = (i, j) => [0, infinite].includes(codes[j * nx + i] & ~DOUBT);
    const path = new Path2D();
    let sides = 0;
    let share = 0;
    const side = (i, j, k, l, x0, y0, x1, y1) => {
      if (inside(i, j) === inside(k, l) || !known(i, j) || !known(k, l)) return;
      sides += 1;
      path.moveTo(x0, 1 - y0);
      path.lineTo(x1, 1 - y1);
    };
    for (let j = 0; j < ny; j += 1)
      for (let i = 0; i < nx; i += 1) {
        share += inside(i, j) / (nx * ny);
        const [right, top] = [x.edges[i + 1], y.edges[j + 1]];
        if (i + 1 < nx) side(i, j, i + 1, j, right, y.edges[j], right, top);
        if (j + 1 < ny) side(i, j, i, j + 1, x.edges[i], top, right, top);
      }
    if (sides && sides <= MOST_SIDES)
      for (const [colour, width] of [[INK, 3.4], ["#ffffff", 1.6]]) {
        context.strokeStyle = colour;
        context.lineWidth = width * pixel;
        context.lineCap = "square";
        context.stroke(path);
      }
    return share;
  };

  const centre = (dim, i) => (dim.edges[i] + dim.edges[i + 1]) / 2;
  const shapes = { // corners around the middle, of the size 1
    triangle: [[0, -1.1], [1, 0.8], [-1, 0.8]],
    square: [[-0.85, -0.85], [0.85, -0.85], [0.85, 0.85], [-0.85, 0.85]],
    diamond: [[0, -1.2], [1.2, 0], [0, 1.2], [-1.2, 0]],
  };
  const draw_marks = (context, x, y) => {
    const [w, h] = [canvas.clientWidth, canvas.clientHeight];
    context.strokeStyle = INK;
    context.fillStyle = "#ffffff";
    for (const pin of about.pins) {
      if (about.dims.some((dim) => dim !== x && dim !== y && pin.at[dim.name] !== view.at[dim.name]))
        continue;
      const [u, v] = [w * centre(x, pin.at[x.name]), h * (1 - centre(y, pin.at[y.name]))];
      context.lineWidth = 2.5;
      context.beginPath();
      if (pin.mark === "circle") context.arc(u, v, 6.5, 0, 7);
      else for (const [a, b] of shapes[pin.mark]) context.lineTo(u + 7 * a, v + 7 * b);
      context.closePath();
      context.fill();
      context.stroke();
    }
    if (!view.cell) return;
    const [i, j] = view.cell;
    const box = [w * x.edges[i], h * (1 - y.edges[j + 1]),
      w * (x.edges[i + 1] - x.edges[i]), h * (y.edges[j + 1] - y.edges[j])];
    for (const [colour, width] of [["#ffffff", 5], ["#000000", 2.5]]) {
      context.strokeStyle = colour;
      context.lineWidth = width;
      context.strokeRect(box[0] - 2, box[1] - 2, box[2] + 4, box[3] + 4);
    }
  };

  // ---- words around the map

  const say = (metric, x, y, codes, inside) => {
    const unit = metric.unit ? ` (${metric.unit})` : "";
    $("title").replaceChildren(element("b", {}, metric.name), `: ${metric.label}${unit}`);
    $("x-label").replaceChildren(labelled(x), " →");
    $("y-label").replaceChildren("↑ ", labelled(y));
    const counts = new Map();
    for (const code of codes) {
      const reason = about.reasons[code & ~DOUBT];
      if (reason) counts.set(reason, (counts.get(reason) || 0) + 1);
      if (code & DOUBT) counts.set("doubtful", (counts.get("doubtful") || 0) + 1);
    }
    const items = [...counts].map(([key, n]) =>
      element("li", { className: key.replaceAll(" ", "-") },
        `${metric.words[key] || key}, ${percent(n / codes.length)}`));
    if (inside > 0 && inside < 1)
      items.push(element("li", { className: "border" }, `converges inside, ${percent(inside)}`));
    $("legend").replaceChildren(...items);
  };
  const colours = () => {
    const metric = metrics.get(view.metric);
    drawing.colours($("bar"), about.palettes[metric.palette], metric.ticks);
  };
  const axes = () => {
    // the width of the labels on the left decides how wide the map is
    tick($("y-ticks"), dims.get(view.y).ticks, true);
    tick($("x-ticks"), dims.get(view.x).ticks, false);
  };

  const read = (cell) => {
    if (!cell) {
      $("readout").textContent =
        "Point at the map to read the values of a cell; click it, or use the arrow keys, to keep one.";
      return;
    }
    const k = offset(view, ...cell);
    const where = about.dims.map((dim) => {
      const i = dim.name === view.x ? cell[0] : dim.name === view.y ? cell[1] : view.at[dim.name];
      return `${dim.name} = ${dim.texts[i]}`;
    });
    const rows = about.metrics.filter((one) => one.values).map((one) => {
      const reason = about.reasons[one.codes[k] & ~DOUBT];
      const number = !reason || reason === "infinite";
      const value = reason ? one.words[reason] || reason : written(one.values[k]);
      const doubt = one.codes[k] & DOUBT ? "not trusted" : "";
      const exact = number ? { "data-exact": String(one.values[k]) } : {};
      return element("tr", {}, element("th", { scope: "row", title: one.label }, ...breakable(one.name)),
        element("td", { "data-name": one.name, ...exact }, value),
        element("td", {}, [reason ? "" : one.unit, doubt].filter(Boolean).join(", ")));
    });
    $("readout").replaceChildren(element("p", { className: "axis" }, where.join(", ")),
      element("table", {}, element("tbody", {}, ...rows)));
  };

  // ---- controls

  const refresh = []; // functions that set a control from the view
  let waiting = false;
  const show = () => {
    for (const one of refresh) one();
    read(view.cell);
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => {
      waiting = false;
      draw();
    });
  };
  const choose = (name, pairs, key, change) => {
    const made = element("select", { ariaLabel: name, name });
    made.append(...pairs.map(([value, text]) => element("option", { value }, text)));
    made.addEventListener("change", () => change(made.value));
    refresh.push(() => { made.value = view[key]; });
    return element("label", {}, name, made);
  };
  const set_axis = (side, name) => {
    const other = side === "x" ? "y" : "x";
    if (view[other] === name) view[other] = view[side];
    view[side] = name;
    view.cell = null;
    axes();
    show();
  };
  const dimension = (dim) => {
    const shown = element("output", {});
    const slider = element("input", {
      type: "range", min: 0, max: dim.texts.length - 1, step: 1, name: `slide.${dim.name}`,
      ariaLabel: `${dim.name}, ${dim.meaning}`,
    });
    slider.addEventListener("input", () => {
      view.at[dim.name] = Number(slider.value);
      show();
    });
    const row = element("div", { className: "field", title: dim.meaning }, labelled(dim), shown, slider);
    refresh.push(() => {
      slider.value = view.at[dim.name];
      shown.textContent = dim.texts[view.at[dim.name]];
      slider.setAttribute("aria-valuetext", shown.textContent);
      row.hidden = [view.x, view.y].includes(dim.name);
    });
    return row;
  };
  const names = about.dims.map((dim) => [dim.name, `${dim.name}: ${dim.meaning}`]);
  $("dials").append(
    choose("Metric", about.metrics.map((one) => [one.name, `${one.name}: ${one.label}`]), "metric",
      async (name) => {
        await load(metrics.get(name));
        view.metric = name;
        colours();
        show();
      }),
    choose("Horizontal axis", names, "x", (name) => set_axis("x", name)),
    choose("Vertical axis", names, "y", (name) => set_axis("y", name)),
    element("fieldset", { hidden: about.dims.length < 3 }, element("legend", {}, "Other dimensions"),
      ...about.dims.map(dimension)));

  // ---- pointer and keys

  const under = (event) => {
    const box = canvas.getBoundingClientRect();
    return [cell_at(dims.get(view.x).edges, (event.clientX - box.left) / box.width),
      cell_at(dims.get(view.y).edges, 1 - (event.clientY - box.top) / box.height)];
  };
  $("map").addEventListener("pointermove", (event) => read(under(event)));
  $("map").addEventListener("pointerleave", () => read(view.cell));
  $("map").addEventListener("click", (event) => {
    view.cell = under(event);
    show();
  });
  const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
  $("map").addEventListener("keydown", (event) => {
    const way = ARROWS[event.key];
    if (!way || event.ctrlKey || event.altKey || event.metaKey) return;
    event.preventDefault();
    const n = [view.x, view.y].map((name) => dims.get(name).texts.length);
    const from = view.cell || n.map((one) => Math.floor(one / 2));
    view.cell = from.map((i, side) =>
      Math.min(Math.max(i + way[side] * (event.shiftKey ? 10 : 1), 0), n[side] - 1));
    show();
  });

  // ---- motions

  const go_to = (pin) => {
    view.at = { ...view.at, ...pin.at };
    view.cell = [pin.at[view.x], pin.at[view.y]];
    show();
    $("map").scrollIntoView({ block: "nearest" });
  };
  const motions = async () => {
    $("motions").append(...about.pins.map((pin) => {
      const button = element("button", { type: "button", ariaLabel: `Show on the map: ${pin.name}` }, "Show");
      button.addEventListener("click", () => go_to(pin));
      const drawn = element("input", { type: "checkbox", checked: true, ariaLabel: `Draw ${pin.name}` });
      drawn.addEventListener("change", () => {
        pin.drawn = drawn.checked;
        plots();
      });
      const note = pin.note ? [element("br"), pin.note] : [];
      return element("li", { "data-nmse": String(pin.nmse) }, drawn, MARKS[pin.mark], line_of(pin.look),
        element("span", {}, element("b", {}, pin.name), `: ${pin.where.join(", ")}; nmse ${written(pin.nmse)}`, ...note),
        button);
    }));
    for (const [i, pin] of about.pins.entries()) {
      pin.signals = {};
      for (const name of ["t", "T", "e", "x", "V", "v", "steps", "branch"])
        pin.signals[name] = await floats_of(`pin-${i}-${name}`);
      pin.drawn = true;
    }
    plots();
  };
  const plots = () => drawing.plots($("plots"),
    about.pins.filter((pin) => pin.drawn).map((pin) => ({ ...pin, ...pin.signals, ...pin.look })));

  // ---- begin

  if (!window.DecompressionStream) {
    $("notice").textContent = "This browser is too old for the data of this page: " +
      "Chrome 80, Firefox 113, Safari 16.4 and all later ones show it.";
    return;
  }
  await load(metrics.get(view.metric));
  if (about.converged) about.convergent = await bytes_of("converged");
  axes();
  colours();
  show();
  new ResizeObserver(() => {
    axes();
    colours();
    show();
  }).observe($("fixed"));
  new ResizeObserver(plots).observe($("runs"));
  for (const metric of about.metrics) await load(metric);
  read(view.cell);
  await motions();
  document.documentElement.dataset.ready = "yes";
})();

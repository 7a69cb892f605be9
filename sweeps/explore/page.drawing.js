"use strict";
// What the explorer's page and a shared file draw alike, with real text: ticks, the bar of colours,
// and motions as SVG.
const drawing = (() => {
  const INK = "#1a1a1a";
  const DASHES = { solid: "", dashed: "7 4", dotdash: "8 3 2 3", dotted: "2 3" };
  const element = (tag, attributes = {}, ...children) => {
    const made = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) {
      if (name === "html") made.innerHTML = value;
      else if (name in made && name !== "list") made[name] = value;
      else made.setAttribute(name, value);
    }
    made.append(...children);
    return made;
  };
  const svg = (tag, attributes = {}, ...children) => {
    const made = document.createElementNS("http://www.w3.org/2000/svg", tag);
    for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
    made.append(...children);
    return made;
  };
  const written = (value, digits) => {
    const plain = Number(value.toPrecision(digits));
    const text = plain !== 0 && (Math.abs(plain) < 1e-4 || Math.abs(plain) >= 1e6)
      ? value.toExponential(digits - 1).replace(/\.?0+e/, "e") : String(plain);
    return text.replaceAll("-", "−");
  };
  const breakable = (name) => // a line may end after each _
    name.split("_").flatMap((part, i) => (i ? ["_", element("wbr"), part] : [part]));

  // texts at places along a side; those that would touch the one before are left out
  const tick = (box, ticks, upright) => {
    box.replaceChildren(...ticks.map(([place, text]) => {
      const made = element("span", {}, text);
      made.style[upright ? "top" : "left"] = `${100 * (upright ? 1 - place : place)}%`;
      return made;
    }));
    const ordered = [...box.children].map((one) => [one, one.getBoundingClientRect()]);
    if (upright) box.style.width = `${8 + Math.max(0, ...ordered.map(([, r]) => r.width))}px`;
    let last = null;
    for (const [one, r] of upright ? ordered.reverse() : ordered) {
      one.hidden = last && (upright ? r.top < last.bottom : r.left < last.right + 6);
      if (!one.hidden) last = r;
    }
  };
  // 256 colours, each a pixel, in the first canvas of `bar`, and ticks below them
  const colours = (bar, palette, ticks) => {
    const image = new ImageData(256, 1);
    new Uint32Array(image.data.buffer).set(palette);
    bar.querySelector("canvas").getContext("2d").putImageData(image, 0, 0);
    tick(bar.querySelector("div"), ticks, false);
  };

  // ---- motions

  const [H, LEFT, BOTTOM] = [180, 74, 26]; // pixels
  const PLOTS = [ // words, signals, the level that is a line, texts of 0 and 1
    ["torque <i>T</i> (N·m) over <i>t</i> (s); grey: <i>T<sub>d</sub></i>", "t", "T", "Td"],
    ["error <i>e</i> (rad) over <i>t</i> (s)", "t", "e"],
    ["position <i>x</i> (rad) over <i>t</i> (s); grey: gap", "t", "x", "gap"],
    ["branch of Algorithm 1 over <i>t</i> (s)", "steps", "branch", "", ["converging", "diverging"]],
    ["Lyapunov function <i>V</i> (J) over <i>t</i> (s)", "t", "V"],
    ["phase portrait: velocity <i>v</i> (rad/s) over position <i>x</i> (rad)", "x", "v"],
  ];
  const round_ticks = (low, high, most) => {
    const rough = (high - low) / most;
    const unit = 10 ** Math.floor(Math.log10(rough));
    const size = unit * [1, 2, 5, 10].find((m) => m * unit >= rough);
    const found = [];
    for (let k = Math.ceil(low / size - 1e-9); k * size <= high + 1e-9 * size; k += 1) found.push(k * size);
    return found;
  };
  const ends = (arrays) => {
    let [low, high] = [Infinity, -Infinity];
    for (const array of arrays) for (const value of array) {
      if (value < low) low = value;
      if (value > high) high = value;
    }
    if (!(low <= high)) return [0, 1]; // all have diverged at once
    const room = 0.04 * (high - low) || 0.1 * Math.abs(high) || 1;
    return [low - room, high + room];
  };
  const plot = (W, motions, [, x, y, level, names], words) => {
    const series = motions.map((one) => [one[x], one[y]]);
    const levels = level ? motions.map((one) => one[level]) : [];
    const [from, to] = ends(series.map((one) => one[0]));
    const [x0, x1] = x === "x" ? [from, to] : [0, to];
    const [y0, y1] = ends([...series.map((one) => one[1]), levels]);
    const u = (value) => LEFT + (value - x0) / (x1 - x0) * (W - LEFT - 8);
    const v = (value) => H - BOTTOM - (value - y0) / (y1 - y0) * (H - BOTTOM - 8);
    const grid = [];
    for (const at of round_ticks(x0, x1, Math.max(2, Math.floor((W - LEFT) / 48))))
      grid.push(svg("path", { d: `M${u(at)} 8V${H - BOTTOM}`, stroke: "#e3e3e3" }),
        svg("text", { x: u(at), y: H - BOTTOM + 15, "text-anchor": "middle" }, written(at, 3)));
    for (const at of names ? [0, 1] : round_ticks(y0, y1, 5))
      grid.push(svg("path", { d: `M${LEFT} ${v(at)}H${W - 8}`, stroke: "#e3e3e3" }),
        svg("text", { x: LEFT - 5, y: v(at) + 4, "text-anchor": "end" }, names ? names[at] : written(at, 3)));
    for (const at of new Set(levels))
      grid.push(svg("path", { d: `M${LEFT} ${v(at)}H${W - 8}`, stroke: "#707070" }));
    const lines = series.map(([a, b], i) => {
      const points = Array.from(a, (value, k) => `${u(value).toFixed(1)} ${v(b[k]).toFixed(1)}`);
      return svg("path", { d: points.length ? `M${points.join("L")}` : "", fill: "none", stroke: motions[i].colour,
        "stroke-width": motions[i].width, "stroke-dasharray": DASHES[motions[i].dash],
        "stroke-linejoin": "round" });
    });
    const frame = svg("rect", { x: LEFT, y: 8, width: W - LEFT - 8, height: H - BOTTOM - 8,
      fill: "none", stroke: INK });
    return svg("svg", { width: W, height: H, role: "img", fill: INK, "aria-label": words },
      ...grid, ...lines, frame);
  };
  // Six plots in a box, as wide as it has room for. A motion has its signals, levels and looks.
  const plots = (box, motions) => {
    box.hidden = motions.length === 0;
    if (box.hidden) return box.replaceChildren();
    if (!box.children.length)
      box.append(...PLOTS.map(([html]) =>
        element("figure", {}, element("figcaption", {}, element("span", { html })))));
    const widths = Array.from(box.children, (figure) => figure.clientWidth);
    for (const [i, figure] of Array.from(box.children).entries()) {
      const words = figure.firstChild.textContent;
      figure.replaceChildren(figure.firstChild, plot(widths[i], motions, PLOTS[i], words));
    }
  };
  const line_of = ({ colour, dash }) =>
    svg("svg", { width: 44, height: 10, "aria-hidden": "true" }, svg("path", { d: "M0 5H44",
      stroke: colour, "stroke-width": 2.2, "stroke-dasharray": DASHES[dash] }));
  return { INK, breakable, element, written, tick, colours, plots, line_of };
})();

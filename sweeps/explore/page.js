"use strict";
// The controls of the page, and its words. The program has all state: an event of a control goes to
// it as a line of JSON, and its answer sets every control and every text.
(() => {
  const about = JSON.parse(document.getElementById("described").textContent);
  const { breakable, element, line_of } = drawing;
  const $ = (id) => document.getElementById(id);
  const model = (name) => Bokeh.documents[0].get_model_by_name(name);
  const MARKS = { circle: "●", triangle: "▲", square: "■", diamond: "◆" };
  const STEPS = 400; // of a slider
  let said = null;
  let count = 0;
  let changing = 0; // the newest event that changes the view

  // ---- events

  const send = (event) => {
    count += 1;
    if (!["ready", "hover", "leave"].includes(event.do)) changing = count;
    model("events").data = { json: [JSON.stringify({ ...event, n: count })] };
  };
  // A slider moves faster than maps come: one event is on its way, the newest one waits.
  let waiting = null;
  let under_way = 0;
  const send_newest = (event) => {
    if (under_way && performance.now() - under_way < 300) {
      waiting = event;
      return;
    }
    waiting = null;
    under_way = performance.now();
    send(event);
  };
  const answered = () => {
    under_way = 0;
    if (waiting) send_newest(waiting);
  };
  const set = (name, value) => send({ do: "set", name, value: String(value) });

  // ---- controls

  const options = (pairs) => pairs.map(([value, text]) => element("option", { value }, text));
  const titled = (text, ...children) =>
    element("fieldset", {}, element("legend", {}, text), ...children);
  const refresh = []; // functions that set a control from the view
  const follow = (control, read) =>
    refresh.push((view) => {
      if (control !== document.activeElement || control.tagName === "SELECT") {
        const value = String(read(view));
        if (control.value !== value) control.value = value;
      }
    });

  const list = (name, pairs, read, change) => {
    const made = element("select", { ariaLabel: name, name });
    made.append(...options(pairs));
    made.addEventListener("change", () => change(made.value));
    follow(made, read);
    return made;
  };
  const entry = (name, read, change) => {
    const made = element("input", { type: "number", step: "any", ariaLabel: name, name });
    made.addEventListener("change", () => made.value !== "" && change(made.value));
    follow(made, read);
    return made;
  };

  const short = (value) => Number(Number(value).toPrecision(3));
  // A slider of a field: on a log scale its steps are even there; its lower end may be zero.
  const position = (field, value) => {
    const part =
      field.scale === "log"
        ? value <= 0 ? 0 : Math.log(value / field.low) / Math.log(field.high / field.low)
        : (value - field.low) / (field.high - field.low);
    return Math.round(STEPS * Math.min(Math.max(part, 0), 1));
  };
  const value_at = (field, place) => {
    if (field.zero && place === 0) return 0;
    const part = place / STEPS;
    if (field.scale === "log") return short(field.low * (field.high / field.low) ** part);
    return short(field.low + (field.high - field.low) * part);
  };
  const field_row = (field) => {
    const slider = element("input", {
      type: "range", min: 0, max: STEPS, step: 1, name: `slide.${field.name}`,
      ariaLabel: `${field.name}, ${field.meaning}`,
    });
    slider.addEventListener("input", () => {
      const value = value_at(field, Number(slider.value));
      number.value = value;
      slider.setAttribute("aria-valuetext", `${value} ${field.unit}`);
      send_newest({ do: "set", name: field.name, value: String(value) });
    });
    const number = entry(field.name, (view) => Number(view.at[field.name]), (value) => set(field.name, value));
    follow(slider, (view) => position(field, Number(view.at[field.name])));
    const row = element("div", { className: "field", title: field.meaning },
      element("span", { html: field.label }), slider, number);
    refresh.push((view) => { row.hidden = [view.x, view.y].includes(field.name); });
    return row;
  };
  const dimension_row = (dim) => {
    const many = dim.values.length === 0;
    const row = element("div", { className: "field", title: dim.meaning }, element("span", { html: dim.label }));
    if (many) {
      row.append(entry(dim.name, (view) => view.at[dim.name], (value) => set(dim.name, value)));
    } else {
      const slider = element("input", {
        type: "range", min: 0, max: dim.values.length - 1, step: 1, name: `slide.${dim.name}`,
        ariaLabel: `${dim.name}, ${dim.meaning}`,
      });
      const shown = element("output", {});
      const show = () => {
        shown.textContent = `${dim.texts[slider.value]} ${dim.unit}`;
        slider.setAttribute("aria-valuetext", shown.textContent);
      };
      slider.addEventListener("input", () => {
        show();
        send_newest({ do: "set", name: dim.name, value: dim.values[slider.value] });
      });
      follow(slider, (view) => Math.max(dim.values.indexOf(view.at[dim.name]), 0));
      refresh.push(show);
      row.append(slider, shown);
      refresh.push((view) => { slider.disabled = view.over.includes(dim.name); });
    }
    if (about.hows.length) {
      const box = element("input", { type: "checkbox", name: `over.${dim.name}` });
      box.addEventListener("change", () => {
        const others = said.view.over.filter((name) => name !== dim.name);
        set("over", [...others, ...(box.checked ? [dim.name] : [])].join(","));
      });
      refresh.push((view) => { box.checked = view.over.includes(dim.name); });
      row.append(element("label", { className: "over" }, box, "all values"));
    }
    refresh.push((view) => { row.hidden = [view.x, view.y].includes(dim.name); });
    return row;
  };

  const axis_box = (side, text) => {
    const change = (name) => send({ do: "axis", side, name });
    const made = titled(text, list(text, about.axes, (view) => view[side], change));
    if (!about.live) return made;
    const range = (view) => view.ranges[view[side]];
    const ends = element("div", { className: "ends" });
    const put = (index, value) => {
      const [low, high, scale] = range(said.view).map((one, i) => (i === index ? value : one));
      set(`range.${said.view[side]}`, `${scale}:${low}:${high}`);
    };
    ends.append(
      entry(`${text}, from`, (view) => range(view)[0], (value) => put(0, value)),
      entry(`${text}, to`, (view) => range(view)[1], (value) => put(1, value)),
      list(`${text}, scale`, [["log", "log"], ["lin", "linear"]], (view) => range(view)[2], (value) => put(2, value)),
    );
    made.append(ends);
    return made;
  };

  for (const id of ["motion-side", "pin", "unpin"]) $(id).hidden = !about.motion;
  const controls = $("controls");
  controls.append(titled("Metric", list("Metric", about.metrics, (view) => view.metric, (value) => set("metric", value))));
  controls.append(axis_box("y", "Vertical axis"), axis_box("x", "Horizontal axis"));
  if (about.live) {
    controls.append(titled("Values", ...about.fields.map(field_row)));
    const choice = ({ name, options }) =>
      element("div", { className: "choice" }, element("span", {}, name),
        list(name, options, (view) => view.at[name], (value) => set(name, value)));
    controls.append(titled("Model", ...about.choices.map(choice)));
    const time = ([name, meaning]) =>
      element("div", { className: "field" }, element("span", {}, `${name}: ${meaning} (s)`),
        entry(name, (view) => Number(view.at[name]), (value) => set(name, value)));
    controls.append(titled("Time", ...about.times.map(time)));
  } else {
    const rows = titled("Other dimensions", ...about.dims.map(dimension_row));
    controls.append(rows);
    refresh.push((view) => { rows.hidden = about.dims.length < 3; });
    if (about.hows.length) {
      const level = element("div", { className: "field" }, element("span", {}, "share of cells at most"),
        entry("level", (view) => view.level, (value) => set("level", value)));
      const how = list("all values", about.hows.map((name) => [name, name]), (view) => view.how, (value) => set("how", value));
      controls.append(titled("Where all values are taken: show the", how, level));
      refresh.push((view) => { level.hidden = view.how !== "share"; });
    }
  }

  // ---- the program's words

  const rows_of = (told) => {
    const table = element("table", {});
    for (const [name, value, unit, exact] of told.rows)
      table.append(element("tr", {}, element("th", { scope: "row" }, ...breakable(name)),
        element("td", { "data-name": name, "data-exact": exact }, value), element("td", {}, unit)));
    const at = told.at.map(([name, value]) => `${name} = ${value}`).join(", ");
    const head = element("p", { className: "axis", html: at });
    return [head, ...(told.note ? [element("p", {}, told.note)] : []), table];
  };
  const motion_of = (one) =>
    element("li", { "data-nmse": one.nmse }, MARKS[one.mark], line_of(one.look),
      `${one.at}: ${one.nmse === "nan" ? "diverged" : `nmse ${Number(one.nmse).toPrecision(4)}`}`);
  let drawn = null; // columns of the motions that the plots show
  const draw_motions = () => {
    drawn = model("motions").data;
    const columns = Object.entries(drawn);
    drawing.plots($("plots"), said.motions.map((_, i) =>
      Object.fromEntries(columns.map(([name, column]) => [name, column[i]]))));
  };
  const draw_bar = () => drawing.colours($("bar"), about.palettes[said.bar.palette], said.bar.ticks);
  const resized = new ResizeObserver(([{ target }]) => {
    if (target === $("bar") && said?.bar) draw_bar();
    if (target === $("motion-side") && said?.motions.length) draw_motions();
  });

  const hear = () => {
    const text = model("words").data.json[0];
    if (!text) return;
    const before = said;
    said = JSON.parse(text);
    document.title = `${said.view.metric} - ${document.querySelector("h1").textContent}`;
    // words that the program sent before it had the newest event would set a control back
    if (said.heard >= changing) for (const one of refresh) one(said.view);
    $("notice").textContent = said.notice;
    $("title").innerHTML = said.title || "";
    $("x-label").innerHTML = `${said.x} →`;
    $("y-label").innerHTML = `↑ ${said.y}`;
    $("legend").replaceChildren(...said.legend.map(([key, words]) =>
      element("li", { className: key.replaceAll(" ", "-") }, words)));
    if (!before || JSON.stringify(before.readout) !== JSON.stringify(said.readout))
      $("readout").replaceChildren(...(said.readout ? rows_of(said.readout) : []));
    $("motions").replaceChildren(...said.motions.map(motion_of));
    $("hint").hidden = said.motions.length > 0;
    if (model("motions").data !== drawn) draw_motions();
    if (said.bar && JSON.stringify(before?.bar) !== JSON.stringify(said.bar)) draw_bar();
    $("undo").disabled = !said.undo;
    $("unpin").disabled = !said.view.pins;
    $("pin").disabled = !said.view.cell;
    $("state").textContent = said.running ? "The sweep is running; its cells appear as they are done." : "";
    history.replaceState(null, "", `?${said.query}`);
    for (const kind of ["png", "svg"]) $(kind).href = `picture.${kind}?${said.query}`;
    if (!before || before.maps !== said.maps || said.notice) answered();
  };

  // ---- pointer, keys, copies

  let last_hover = 0;
  const pointer = (event) => {
    const { x, y } = event;
    if (event.event_name.endsWith("tap")) { // a quick second click is a double one
      send({ do: "tap", x, y, pin: Boolean(event.modifiers?.shift) });
      $("map").focus({ preventScroll: true });
    } else if (event.event_name === "mouseleave") send({ do: "leave" });
    else if (performance.now() - last_hover > 60) {
      last_hover = performance.now();
      send({ do: "hover", x, y });
    }
  };
  const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
  document.addEventListener("keydown", (event) => {
    const free = document.activeElement === document.body || document.activeElement === $("map");
    const typing = ["number", "text", "textarea"].includes(document.activeElement.type);
    if ((event.ctrlKey || event.metaKey) && event.key === "z" && !typing) {
      event.preventDefault();
      send({ do: "undo" });
    } else if (free && ARROWS[event.key] && !event.ctrlKey && !event.altKey) {
      event.preventDefault();
      const [dx, dy] = ARROWS[event.key];
      send({ do: "move", dx: event.shiftKey ? 10 * dx : dx, dy: event.shiftKey ? 10 * dy : dy });
    } else if (document.activeElement === $("map") && event.key === "Enter") send({ do: "pin" });
  });
  for (const name of ["undo", "fit", "pin", "unpin"])
    $(name).addEventListener("click", () => send({ do: name }));

  const copy = async (what, text) => {
    try {
      await navigator.clipboard.writeText(text);
      $("copied").textContent = `${what} is copied.`;
      setTimeout(() => { $("copied").textContent = ""; }, 4000);
    } catch { // a browser gives the clipboard to https and to this machine alone
      $("copy").querySelector("textarea").value = text;
      $("copy").showModal();
      $("copy").querySelector("textarea").select();
    }
  };
  const copy_from = (what, address) => async () => {
    const answer = await fetch(`${address}?${said.query}`);
    if (answer.ok) copy(what, await answer.text());
    else $("notice").textContent = await answer.text();
  };
  $("link").addEventListener("click", () => copy("The link", location.href));
  $("python").addEventListener("click", copy_from("The Python program", "view.py"));
  $("toml").addEventListener("click", copy_from("The sweep file", "view.toml"));

  // The address has the whole view: once the program answers again, the page is as it was.
  const lost = () => {
    $("notice").textContent =
      "The connection to the program is lost. If it has ended, start it again: this page waits for it.";
    const again = () => fetch("view.toml").then(() => location.reload(), () => setTimeout(again, 1000));
    setTimeout(again, 500);
  };
  window.explorer = { hear, pointer, lost, said: () => said };
  const begin = () => {
    if (window.Bokeh?.documents?.length && model("words")) {
      hear();
      for (const id of ["bar", "motion-side"]) resized.observe($(id));
      // Bokeh's own stop of the Tab key, within the map: keys would do nothing there
      let within = $("map").querySelector(".bk-Plot");
      for (const name of [".bk-Canvas", ".bk-events"]) within = within?.shadowRoot?.querySelector(name);
      within?.setAttribute("tabindex", "-1");
      send({ do: "ready" });
    } else setTimeout(begin, 20);
  };
  begin();
})();

"use strict";
// Every page: the button between light and dark.
const theme = document.getElementById("theme");
if (theme) {
  const root = document.documentElement;
  const stored = () => { try { return localStorage.getItem("brainbench-theme"); } catch { return null; } };
  const dark = () => (root.dataset.theme || (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light")) === "dark";
  const show = () => { theme.textContent = dark() ? "Light" : "Dark"; theme.setAttribute("aria-label", `Switch to ${dark() ? "light" : "dark"} colours`); };
  if (stored() === "dark" || stored() === "light") root.dataset.theme = stored();
  theme.hidden = false;
  show();
  theme.addEventListener("click", () => {
    root.dataset.theme = dark() ? "light" : "dark";
    try { localStorage.setItem("brainbench-theme", root.dataset.theme); } catch { /* private window: not kept */ }
    show();
  });
}

// The leaderboard: rows are made here from compact columns, 50 at a time, with textContent alone.
const source = document.getElementById("data");
if (source) {
  const { boards, columns: kinds, page: PAGE } = JSON.parse(source.textContent);
  const MARGIN = 4; // percent of the cell kept free on each side, so that marks at the ends are not cut
  const $ = (id) => document.getElementById(id);
  const SVG = "http://www.w3.org/2000/svg";
  const RANGES = [["", "any"], ["0-1e6", "up to 1 M"], ["1e6-5e6", "1 to 5 M"], ["5e6-3e7", "5 to 30 M"], ["3e7-1e99", "over 30 M"]];
  const FILTERS = ["encoder", "attender", "objective"];
  const DEFAULT = kinds.filter((kind) => kind.shown).map((kind) => kind.key);
  const state = { board: 0, q: "", encoder: "", attender: "", objective: "", parameters: "", sort: "score", way: -1, page: 0, columns: DEFAULT };

  const make = (tag, text, attributes = {}) => {
    const node = document.createElement(tag);
    if (text !== undefined && text !== null) node.textContent = text;
    for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
    return node;
  };
  const draw = (tag, attributes) => {
    const node = document.createElementNS(SVG, tag);
    for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
    return node;
  };
  const number = (value, digits = 3) => (value === null ? "undefined" : value.toFixed(digits).replace(/^-(0\.?0*)$/, "$1").replace("-", "−"));
  const small = (value) => (value === null ? "" : Number(value.toPrecision(2)).toString());
  const count = (value) => (value === null ? "" : value.toLocaleString("en"));

  // Columns of one board become row objects when the board is first looked at.
  const rowsOf = (board) => {
    if (board.rows) return board.rows;
    const names = Object.keys(board.data);
    const length = names.length ? board.data[names[0]].length : 0;
    board.rows = Array.from({ length }, (_, i) => Object.fromEntries(names.map((name) => [name, board.data[name][i]])));
    return board.rows;
  };
  // A model that is not told apart from chance never stands above the raw input, whatever its score.
  const TIERS = { "not told apart from chance": 1, "not tested": 2, unreliable: 3, undefined: 4 };
  const tier = (row) => (row.kind === "model" ? TIERS[row.standing] ?? 0 : 0);

  const shown = () => {
    const board = boards[state.board];
    const [least, most] = state.parameters ? state.parameters.split("-").map(Number) : [0, Infinity];
    const words = state.q.toLowerCase().split(/\s+/).filter(Boolean);
    const rows = rowsOf(board).filter((row) => {
      const text = `${row.name} ${row.objective ?? ""} ${row.augmentation ?? ""} ${row.layer ?? ""}`.toLowerCase();
      if (!words.every((word) => text.includes(word))) return false;
      if (row.kind !== "model") return true;
      if (FILTERS.some((name) => state[name] && (row[name] ?? "not stated") !== state[name])) return false;
      return !state.parameters || (row.parameters !== null && row.parameters > least && row.parameters <= most);
    });
    const key = kinds.find((kind) => kind.key === state.sort) ?? kinds[0];
    const value = (row) => (key.key === "rank" ? row.rank_first : row[key.key]);
    const place = (row) => (state.sort === "score" ? tier(row) : 0);
    return rows.map((row) => [value(row), row]).sort(([a, one], [b, other]) => {
      const ranked = place(one) - place(other);
      if (ranked) return ranked;
      const none = [a, b].map((item) => item === null || item === undefined || item === "");
      if (none[0] || none[1]) return none[0] - none[1];
      return state.way * (typeof a === "number" ? a - b : String(a).localeCompare(String(b), "en", { numeric: true }));
    }).map(([, row]) => row);
  };

  const plot = (row, axis) => {
    const at = (value) => MARGIN + ((100 - 2 * MARGIN) * (Math.min(Math.max(value, axis.low), axis.high) - axis.low)) / (axis.high - axis.low);
    const svg = draw("svg", { class: `plot ${row.kind}${row.kind === "model" && tier(row) ? " unreliable" : ""}`, "aria-hidden": "true" });
    svg.append(draw("use", { href: "#grid" }));
    for (const run of row.runs ?? []) if (run !== null) svg.append(draw("circle", { class: "point", cx: `${at(run)}%`, cy: "50%", r: 2.4 }));
    if (row.score_low !== null) svg.append(draw("line", { class: "span", x1: `${at(row.score_low)}%`, x2: `${at(row.score_high)}%`, y1: "50%", y2: "50%" }));
    const seen = [row.score, row.score_low, row.score_high].filter((value) => value !== null);
    if (seen.some((value) => value < axis.low)) svg.append(draw("use", { class: "arrow", href: "#left", x: `${MARGIN}%`, y: "50%" }));
    if (seen.some((value) => value > axis.high)) svg.append(draw("use", { class: "arrow", href: "#right", x: `${100 - MARGIN}%`, y: "50%" }));
    if (row.score !== null && row.score >= axis.low && row.score <= axis.high) svg.append(draw("use", { class: "value", href: { model: "#dot", baseline: "#diamond", animals: "#square" }[row.kind], x: `${at(row.score)}%`, y: "50%" }));
    return svg;
  };

  const cell = (row, kind, board) => {
    const value = row[kind.key];
    if (kind.key === "name") {
      const head = make("th", null, { scope: "row" });
      const name = make("bdi");
      row.name.split(/(?<=[+.:/])/).forEach((part, i) => name.append(...(i ? [make("wbr")] : []), part)); // may break after + and .
      if (row.page) { const link = make("a", null, { href: `models/${row.page}` }); link.append(name); head.append(link); } else head.append(name);
      const facts = [row.kind === "model" && row.objective, row.augmentation].filter(Boolean);
      if (facts.length) head.append(make("small", facts.join(" · ")));
      const doubts = [row.same_as && `same computation as ${row.same_as}`, row.apart && `not repeatable here: ${row.apart}`, !row.apart && !(row.standing in TIERS) && board.ranked && row.unranked_because && `not ranked: ${row.unranked_because}`, row.notes];
      for (const doubt of doubts.filter(Boolean)) head.append(make("small", doubt.length > 90 ? `${doubt.slice(0, 88)}…` : doubt, { class: "doubt", title: doubt }));
      if (row.get) { const how = make("details"); how.append(make("summary", "get it"), ...row.get.split("; ").map((line) => make("code", line))); head.append(how); }
      return head;
    }
    const td = make("td", null, { class: [kind.number ? "n" : kind.key === "layer" ? "text" : "", kind.wide ? "wide" : "", kind.key].filter(Boolean).join(" ") });
    if (kind.key === "interval") { td.className = "chart"; td.append(plot(row, board.axis)); return td; }
    if (kind.key === "rank") td.textContent = row.rank_first === null ? "–" : row.rank_first === row.rank_last ? row.rank_first : `${row.rank_first}–${row.rank_last}`;
    else if (kind.key === "score") { td.append(number(value)); if (row.score_low !== null) td.append(make("span", ` [${number(row.score_low)}, ${number(row.score_high)}]`, { class: "interval" })); }
    else if (kind.key === "standing" && value) td.append(make("span", value, { class: `chip ${value.replaceAll(" ", "-")}` }));
    else if (value === null || value === undefined) td.textContent = "";
    else if (kind.key === "p") td.textContent = small(value);
    else if (kind.whole) td.textContent = count(value);
    else if (kind.number) td.textContent = number(value);
    else td.append(make("bdi", value));
    return td;
  };

  const header = (kind, board) => {
    const th = make("th", null, { scope: "col", class: [kind.key === "interval" ? "chart" : kind.number ? "n" : "", kind.wide ? "wide" : ""].filter(Boolean).join(" ") });
    if (kind.key === "interval") {
      const { low, high, ticks } = board.axis;
      th.append(make("span", `interval on a scale from ${number(low, 2)} to ${number(high, 2)}`, { class: "heard" }));
      const svg = draw("svg", { class: "axis", "aria-hidden": "true" });
      for (const tick of ticks) {
        const text = draw("text", { x: `${MARGIN + ((100 - 2 * MARGIN) * (tick - low)) / (high - low)}%`, y: 14, ...(tick % 0.5 ? { class: "minor" } : {}) });
        text.textContent = String(tick).replace("-", "−");
        svg.append(text);
      }
      th.append(svg);
      return th;
    }
    const button = make("button", kind.label, { type: "button", "data-sort": kind.key });
    if (state.sort === kind.key) th.setAttribute("aria-sort", state.way < 0 ? "descending" : "ascending");
    th.append(button);
    return th;
  };

  const grid = (board) => {
    $("grid")?.remove();
    const { low, high, ticks } = board.axis;
    const at = (value) => MARGIN + ((100 - 2 * MARGIN) * (Math.min(Math.max(value, low), high) - low)) / (high - low);
    const group = draw("g", { id: "grid", class: "grid" });
    if (board.band) group.append(draw("rect", { class: "band", x: `${at(board.band[0])}%`, width: `${at(board.band[1]) - at(board.band[0])}%`, height: "100%" }));
    for (const tick of ticks) group.append(draw("line", { x1: `${at(tick)}%`, x2: `${at(tick)}%`, y2: "100%", ...(tick === 0 ? { class: "zero" } : tick === 1 ? { class: "one" } : {}) }));
    document.querySelector("svg.defs defs").append(group);
  };

  const render = () => {
    const board = boards[state.board];
    const rows = shown();
    const pages = Math.max(1, Math.ceil(rows.filter((row) => !row.apart).length / PAGE));
    state.page = Math.min(state.page, pages - 1);
    // No column of ranks where every model ties, no second one of values where no record states its chance.
    const visible = kinds.filter((kind) => state.columns.includes(kind.key) && (kind.key !== "rank" || board.ranked) && (kind.key !== "value" || board.scaled));
    const part = rows.filter((row) => !row.apart).slice(state.page * PAGE, (state.page + 1) * PAGE);
    const apart = rows.filter((row) => row.apart);
    const table = $("ranking");
    table.caption.textContent = `${board.scaled ? "Score from chance (0) to all that is reliable (1), with its interval" : "Value in the metric's own unit: these records state no chance"}.${board.band ? " The green band is the interval of animal-to-animal." : ""}`;
    const line = make("tr");
    line.append(...visible.map((kind) => header(kind, board)));
    table.tHead.replaceChildren(line);
    const lines = (some) => some.map((row, i) => {
      const tr = make("tr", null, { class: row.kind });
      if (state.sort === "score" && i && tier(some[i - 1]) !== tier(row)) tr.classList.add("apart");
      tr.append(...visible.map((kind) => cell(row, kind, board)));
      return tr;
    });
    table.tBodies[0].replaceChildren(...lines(part));
    const aside = $("apart").firstElementChild;
    $("apart").hidden = !apart.length;
    aside.tHead.replaceChildren(line.cloneNode(true));
    aside.tBodies[0].replaceChildren(...lines(apart));
    if (!part.length) {
      const td = make("td", "No model fits these filters.", { colspan: visible.length });
      const tr = make("tr");
      tr.append(td);
      table.tBodies[0].append(tr);
    }
    const models = rows.filter((row) => row.kind === "model").length;
    const all = rowsOf(board).filter((row) => row.kind === "model").length;
    $("status").textContent = `${models === all ? `${all} models` : `${models} of ${all} models`}, ${rows.length - models} baselines.`;
    $("pages").hidden = pages < 2;
    $("page").textContent = `${state.page + 1} of ${pages}`;
    $("previous").disabled = state.page === 0;
    $("next").disabled = state.page === pages - 1;
  };

  const option = (value, text) => make("option", text, { value });
  const fill = () => {
    const board = boards[state.board];
    const recordings = [...new Set(boards.map((item) => item.recordings))];
    $("recordings").replaceChildren(...recordings.map((name) => option(name, name)));
    $("recordings").value = board.recordings;
    $("metric").replaceChildren(...boards.map((item, i) => [item, i]).filter(([item]) => item.recordings === board.recordings).map(([item, i]) => option(String(i), item.label)));
    $("metric").value = String(state.board);
    // The menu may be narrower than what it says.
    $("metric").title = board.label;
    for (const name of FILTERS) {
      const values = [...new Set(rowsOf(board).filter((row) => row.kind === "model").map((row) => row[name] ?? "not stated"))].sort();
      $(name).replaceChildren(option("", "all"), ...values.map((value) => option(value, value)));
      if (!values.includes(state[name])) state[name] = "";
      $(name).value = state[name];
    }
    $("parameters").replaceChildren(...RANGES.map(([value, text]) => option(value, text)));
    $("parameters").value = state.parameters;
    $("q").value = state.q;
    for (const box of document.querySelectorAll(".columns input")) box.checked = state.columns.includes(box.value);
    $("about").replaceChildren(...board.about.map((text) => make("bdi", text)).flatMap((node, i) => (i ? [" ", node] : [node])));
    $("concluded").replaceChildren(make("ul"));
    for (const text of board.conclusions) { const item = make("li"); item.append(make("bdi", text)); $("concluded").firstChild.append(item); }
    grid(board);
  };

  // The address keeps the view, so that a link shows the same rows.
  const write = () => {
    const found = new URLSearchParams();
    if (state.board) found.set("board", boards[state.board].key);
    for (const name of ["q", ...FILTERS, "parameters"]) if (state[name]) found.set(name, state[name]);
    if (state.sort !== "score" || state.way !== -1) found.set("sort", `${state.way < 0 ? "-" : ""}${state.sort}`);
    if (state.page) found.set("page", String(state.page + 1));
    if (state.columns.join() !== DEFAULT.join()) found.set("columns", state.columns.join());
    history.replaceState(null, "", `#${found}`);
  };
  const read = () => {
    const found = new URLSearchParams(location.hash.slice(1));
    const text = (name) => found.get(name) ?? "";
    state.board = Math.max(0, boards.findIndex((board) => board.key === text("board")));
    for (const name of ["q", ...FILTERS]) state[name] = text(name);
    state.parameters = RANGES.some(([value]) => value === text("parameters")) ? text("parameters") : "";
    const sort = text("sort") || "-score";
    const name = sort.replace(/^-/, "");
    if (kinds.some((kind) => kind.key === name && kind.key !== "interval")) { state.sort = name; state.way = sort.startsWith("-") ? -1 : 1; }
    state.page = Math.max(0, (parseInt(text("page"), 10) || 1) - 1);
    const columns = text("columns").split(",").filter((key) => kinds.some((kind) => kind.key === key));
    state.columns = columns.length ? kinds.map((kind) => kind.key).filter((key) => key === "name" || columns.includes(key)) : DEFAULT;
  };
  const update = (change, first = true) => { Object.assign(state, change); if (first) state.page = 0; write(); render(); };

  const chooser = document.querySelector(".columns > div");
  for (const kind of kinds.filter((item) => item.key !== "name")) {
    const label = make("label");
    label.append(make("input", null, { type: "checkbox", value: kind.key }), kind.title);
    chooser.append(label);
  }
  chooser.addEventListener("change", () => {
    const picked = [...chooser.querySelectorAll("input:checked")].map((box) => box.value);
    update({ columns: kinds.map((kind) => kind.key).filter((key) => key === "name" || picked.includes(key)) }, false);
  });
  addEventListener("click", (event) => { const menu = chooser.parentNode; if (menu.open && !menu.contains(event.target)) menu.open = false; });
  addEventListener("keydown", (event) => { const menu = chooser.parentNode; if (event.key === "Escape" && menu.open) { menu.open = false; menu.querySelector("summary").focus(); } });
  $("recordings").addEventListener("change", (event) => { update({ board: boards.findIndex((board) => board.recordings === event.target.value) }); fill(); });
  $("metric").addEventListener("change", (event) => { update({ board: Number(event.target.value) }); fill(); render(); });
  for (const name of [...FILTERS, "parameters"]) $(name).addEventListener("change", (event) => update({ [name]: event.target.value }));
  $("q").addEventListener("input", (event) => update({ q: event.target.value }));
  $("filters").addEventListener("reset", (event) => { event.preventDefault(); update({ q: "", encoder: "", attender: "", objective: "", parameters: "", sort: "score", way: -1, columns: DEFAULT }); fill(); });
  $("filters").addEventListener("submit", (event) => event.preventDefault());
  $("link").addEventListener("click", async () => {
    write();
    let text = "Copied";
    try { await navigator.clipboard.writeText(location.href); } catch { text = "Copy it from the address bar"; }
    $("link").textContent = text;
    setTimeout(() => { $("link").textContent = "Copy link"; }, 2000);
  });
  $("ranking").tHead.addEventListener("click", (event) => {
    const key = event.target.closest("[data-sort]")?.dataset.sort;
    if (!key) return;
    const kind = kinds.find((item) => item.key === key);
    const way = state.sort === key ? -state.way : kind.down ? -1 : 1;
    update({ sort: key, way });
    $("ranking").querySelector(`[data-sort="${key}"]`).focus();
  });
  for (const [id, step] of [["previous", -1], ["next", 1]]) $(id).addEventListener("click", () => { update({ page: state.page + step }, false); $("ranking").scrollIntoView(); });
  addEventListener("hashchange", () => { read(); fill(); render(); });

  read();
  fill();
  render();
  $("filters").hidden = false;
}

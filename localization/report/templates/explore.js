// Draws the interactive part of a replay's page with Plotly from the JSON of localization/report/interactive.py.
(() => {
  const {colour, config, before, layout, axis, logTicks} = skidloc;
  const data = JSON.parse(document.getElementById("explore-data").textContent);
  const box = id => document.getElementById("explore-" + id);
  const runs = data.runs;
  const end = Math.max(...runs.map(run => run.t[run.t.length - 1]));
  const scanTimes = data.scans.map(scan => scan[0]);
  let now = end;

  const style = run => ({color: colour(run.colour), width: 2, dash: run.dash});
  const isWay = () => box("axis").value === "way";
  const along = (run, part) => isWay() ? (part ? part.way : run.way) : (part || run).t;
  const wayAt = run => run.way[before(run.t, now)];

  const isStart = () => box("aligned").value === "start";
  const errors = run => isStart() ? run.errors && run.errors.start && {...run.errors, ...run.errors.start} : run.errors;

  // The grid of a saved map, below everything else.
  const picture = () => data.grid ? [{source: data.grid.source, xref: "x", yref: "y", x: data.grid.left, y: data.grid.top,
    sizex: data.grid.width, sizey: data.grid.height, sizing: "stretch", layer: "below"}] : [];

  const mapTraces = () => {
    const traces = [{x: data.map.x, y: data.map.y, mode: "markers", type: "scatter", name: "map", hoverinfo: "skip",
                     marker: {size: 2, color: colour("grey"), opacity: .6}, visible: data.map.x.length ? true : "legendonly"}];
    if (data.reference) traces.push({x: data.reference.x, y: data.reference.y, customdata: data.reference.t, mode: "lines", name: "reference",
      line: {color: colour("ink"), width: 1.5, dash: "dot"}, hovertemplate: "reference<br>%{customdata:.1f} s<br>%{x:.2f}, %{y:.2f} m<extra></extra>"});
    runs.forEach(run => {
      traces.push({x: run.x, y: run.y, customdata: run.t.map((t, i) => [t, run.heading[i], run.sigma ? run.sigma[i] : NaN]), mode: "lines",
        name: run.label, legendgroup: run.label, line: style(run),
        hovertemplate: run.label + "<br>%{customdata[0]:.1f} s<br>%{x:.2f}, %{y:.2f} m, %{customdata[1]:.0f}°<br>sigma %{customdata[2]:.3g} m<extra></extra>"});
      if (run.loops.length) traces.push({x: run.loops.flatMap(l => [l[0], l[2], null]), y: run.loops.flatMap(l => [l[1], l[3], null]),
        mode: "lines", name: run.loops.length + " loops, " + run.label, hoverinfo: "skip", visible: "legendonly",
        line: {color: colour("accent"), width: 1}});
    });
    runs.forEach((run, i) => run.ellipse && traces.push({x: [], y: [], mode: "lines", name: "two sigma now", legendgroup: run.label, showlegend: false,
      hoverinfo: "skip", meta: i, line: {color: colour(run.colour), width: 1.5}}));
    if (data.scans.length) traces.push({x: [], y: [], mode: "markers", name: "scan now", hoverinfo: "skip", marker: {size: 3, color: colour("accent")}});
    traces.push({x: [], y: [], mode: "markers", name: "now", hoverinfo: "skip", showlegend: false,
                 marker: {size: 11, color: [], line: {color: colour("paper"), width: 2}}});
    return traces;
  };

  // Rows of the time series: title, unit, and the series of one run or null.
  const rows = () => [
    ["position error [m]", "log", run => errors(run) && [along(run, errors(run)), errors(run).position]],
    ["heading error [deg]", "log", run => errors(run) && errors(run).heading && [along(run, errors(run)), errors(run).heading]],
    ["position sigma [m]", "log", run => run.sigma && [along(run), run.sigma]],
    ["NIS (3 expected)", "log", run => run.nis && [run.nis.t.map(t => isWay() ? run.way[before(run.t, t)] : t), run.nis.nis]],
  ].concat(parameter(), difference()).filter(row => runs.some(run => row[2](run)));

  const parameter = () => {
    const name = box("parameter").value;
    return name ? [[name + " ± sigma", "linear", run => {
      const p = run.parameters[name];
      return p && [p.t.map(t => isWay() ? run.way[before(run.t, t)] : t), p.mean, p.sigma];
    }]] : [];
  };
  const difference = () => {
    const [a, b] = ["a", "b"].map(name => runs[+box(name).value]);
    if (!a || !b || a === b) return [];
    const apart = a.t.map((t, i) => {
      const k = before(b.t, t);
      return Math.hypot(a.x[i] - b.x[k], a.y[i] - b.y[k]);
    });
    return [["A to B [m]", "linear", run => run === a && [along(a), apart]]];
  };

  const timeFigure = () => {
    const found = rows(), gap = .07, height = (1 - gap * (found.length - 1)) / Math.max(found.length, 1);
    const traces = [], more = {hovermode: "x unified", height: 150 * found.length + 100, xaxis: axis(isWay() ? "way [m]" : "time [s]", {anchor: "y" + (found.length > 1 ? found.length : "")})};
    found.forEach(([title, type, series], i) => {
      const name = i ? String(i + 1) : "", top = 1 - i * (height + gap);
      more["yaxis" + name] = axis("", {type, domain: [Math.max(top - height, 0), top], ...(type === "log" ? logTicks : {}), automargin: true});
      runs.forEach(run => {
        const s = series(run);
        if (s && s[2]) [1, -1].forEach(sign => traces.push({x: s[0], y: s[1].map((m, k) => m + sign * s[2][k]), yaxis: "y" + name, mode: "lines",
          line: {width: 0}, fill: sign < 0 ? "tonexty" : "none", fillcolor: colour(run.colour) + "30", showlegend: false, hoverinfo: "skip",
          legendgroup: run.label}));
        if (s) traces.push({x: s[0], y: s[1], yaxis: "y" + name, mode: "lines", name: run.label, legendgroup: run.label,
          showlegend: !traces.some(t => t.name === run.label), line: {...style(run), width: 1.4}, hovertemplate: "%{y:.3g}"});
      });
    });
    more.annotations = found.map(([title], i) => ({text: title, xref: "paper", yref: "paper", x: 0, y: 1 - i * (height + gap), showarrow: false,
      xanchor: "left", yanchor: "bottom", font: {size: 12, color: colour("soft")}}));
    more.shapes = shapes();
    return [traces, layout(more)];
  };
  const shapes = () => {
    const line = isWay() ? wayAt(runs[0]) : now;
    const bands = runs.flatMap(run => run.lost.map(([from, to]) => {
      const at = t => isWay() ? run.way[before(run.t, t)] : t;
      return {type: "rect", xref: "x", yref: "paper", x0: at(from), x1: at(to), y0: 0, y1: 1, line: {width: 0},
              fillcolor: colour(run.colour), opacity: .18, layer: "below"};
    }));
    const slips = runs.flatMap(run => run.slips.map(([from, to]) => {
      const at = t => isWay() ? run.way[before(run.t, t)] : t;
      return {type: "rect", xref: "x", yref: "paper", x0: at(from), x1: at(to), y0: 0, y1: 1, line: {color: colour("orange"), width: 1},
              fillcolor: colour("orange"), opacity: .3, layer: "below"};
    }));
    const faults = runs.flatMap(run => run.faults.map(([t]) => isWay() ? run.way[before(run.t, t)] : t)).map(t => ({type: "line", xref: "x",
      yref: "paper", x0: t, x1: t, y0: 0, y1: 1, line: {color: colour("red"), width: 1, dash: "dot"}, layer: "below"}));
    return [...bands, ...slips, ...faults, {type: "line", xref: "x", yref: "paper", x0: line, x1: line, y0: 0, y1: 1, line: {color: colour("accent"), width: 1.5}}];
  };

  // Two sigma of the position of `run` at its pose k, as a closed line.
  const ellipseNow = (run, k) => {
    const [a, b, angle] = run.ellipse.map(column => column[k]), turns = [...Array(49).keys()].map(i => 2 * Math.PI * i / 48);
    const [c, s] = [Math.cos(angle), Math.sin(angle)];
    return [turns.map(u => run.x[k] + a * c * Math.cos(u) - b * s * Math.sin(u)), turns.map(u => run.y[k] + a * s * Math.cos(u) + b * c * Math.sin(u))];
  };
  const show = t => {
    now = Math.min(Math.max(t, 0), end);
    box("slider").value = now;
    const at = runs.map(run => before(run.t, now));
    const track = data.reference ? before(data.reference.t, now) : 0;
    const points = {x: runs.map((run, i) => run.x[at[i]]), y: runs.map((run, i) => run.y[at[i]]), c: runs.map(run => colour(run.colour))};
    if (data.reference) points.x.push(data.reference.x[track]), points.y.push(data.reference.y[track]), points.c.push(colour("ink"));
    Plotly.restyle(box("map"), {x: [points.x], y: [points.y], "marker.color": [points.c]}, [box("map").data.length - 1]);
    const layers = box("map").data.map((trace, k) => [k, trace.meta]).filter(([, i]) => i !== undefined).map(([k, i]) => [k, ...ellipseNow(runs[i], at[i])]);
    if (data.scans.length) layers.push([box("map").data.length - 2, ...data.scans[before(scanTimes, now)].slice(1)]);
    if (layers.length) Plotly.restyle(box("map"), {x: layers.map(l => l[1]), y: layers.map(l => l[2])}, layers.map(l => l[0]));
    Plotly.relayout(box("time"), {shapes: shapes()});
    box("now").textContent = now.toFixed(1) + " s";
  };
  // Part of the map that is shown: what was zoomed to stays.
  const part = name => box("map").layout ? [...box("map").layout[name + "axis"].range] : data.borders[name];
  const isNarrow = () => box("map").clientWidth < 500;
  const drawMap = () => {
    const traces = mapTraces();
    const size = isNarrow() ? box("map").clientWidth * .9 + 13 * traces.length : Math.min(Math.max(box("map").clientWidth * .62, 300), 620);
    Plotly.react(box("map"), traces, layout({height: size, dragmode: "pan", images: picture(), xaxis: axis("x [m]", {range: part("x")}),
      yaxis: axis("y [m]", {range: part("y"), scaleanchor: "x", scaleratio: 1})}), config);
  };
  const drawTime = () => {
    const [curves, more] = timeFigure();
    const margin = {...more.margin, t: isNarrow() ? 26 : more.margin.t};  // without a legend, the first title needs it
    Plotly.react(box("time"), curves, {...more, margin, showlegend: !isNarrow()}, {...config, scrollZoom: false});
    show(now);
  };
  const draw = () => { drawMap(); drawTime(); };

  for (const name of ["a", "b"]) {
    box(name).add(new Option("–", "-1"));
    runs.forEach((run, i) => box(name).add(new Option(run.label, i)));
  }
  const faults = new Map(runs.flatMap(run => run.faults.map(([t, text]) => [text, [t, "fault: " + text]])));  // of several runs once
  const events = [...faults.values(), ...runs.flatMap(run => run.lost.map(l => [l[0], "no scan matched for " + (l[1] - l[0]).toFixed(1) + " s, " + run.label])),
                  ...runs.flatMap(run => run.slips.map(l => [l[0], "scan against wheels " + l[2].toFixed(0) + " sigma (slip or push), " + run.label])),
                  ...runs.flatMap(run => run.loops.map(l => [l[4], "loop closed, " + run.label]))].sort((p, q) => p[0] - q[0]);
  events.forEach(([t, text]) => box("event").add(new Option(t.toFixed(1) + " s: " + text, t)));
  const names = [...new Set(runs.flatMap(run => Object.keys(run.parameters)))];
  names.forEach(name => box("parameter").add(new Option(name, name)));
  box("parameter").value = names[0] || "";
  box("parameter").parentElement.hidden = !names.length;
  box("event").parentElement.hidden = !events.length;
  box("aligned").parentElement.hidden = !runs.some(run => run.errors && run.errors.start);
  box("slider").max = end;
  draw();
  box("slider").addEventListener("input", event => show(+event.target.value));
  box("event").addEventListener("change", event => event.target.value && show(+event.target.value));
  ["axis", "aligned", "a", "b", "parameter"].forEach(name => box(name).addEventListener("change", drawTime));
  box("time").on("plotly_click", event => {
    const x = event.points[0].x;
    show(isWay() ? runs[0].t[before(runs[0].way, x)] : x);
  });
  box("map").on("plotly_click", event => {
    const t = event.points[0].customdata;
    if (t !== undefined) show(Array.isArray(t) ? t[0] : t);
  });
  skidloc.onTheme(draw);
})();

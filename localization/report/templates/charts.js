// Draws the charts of localization/report/charts.py with Plotly: one for each element of class "chart".
document.querySelectorAll(".chart").forEach(root => {
  const {colour, axis, layout, config} = skidloc;
  const chart = JSON.parse(root.querySelector("script").textContent);
  const place = root.querySelector(".chart-place");
  const choice = {x: chart.x[0][0], y: chart.y[0][0], scale: chart.x_type};
  const column = (name, group = "") => chart.columns[group + name];
  const titleOf = (entries, name) => (entries.find(entry => entry[0] === name) || ["", ""])[1];
  const choose = (label, entries, key) => {
    if (entries.length < 2) return;
    const list = document.createElement("select");
    list.dataset.key = key;
    entries.forEach(([name, title]) => list.add(new Option(title, name)));
    list.value = choice[key];
    list.addEventListener("change", () => { choice[key] = list.value; draw(); });
    const element = document.createElement("label");
    element.append(label + " ", list);
    root.querySelector(".controls").append(element, " ");
  };
  const panels = chart.is_y_chosen ? 1 : chart.y.length;
  const xName = s => s.x || choice.x, yName = s => s.y || choice.y;
  const trace = s => {
    const x = column(xName(s), s.group), y = column(yName(s), s.group), axisName = "y" + (s.panel ? s.panel + 1 : "");
    const drawn = {x, y, yaxis: axisName, name: s.name, showlegend: s.name !== "" && s.panel === Math.min(...chart.series.filter(o => o.name === s.name).map(o => o.panel)),
      legendgroup: s.name, mode: s.is_line ? "lines" : "markers", visible: s.is_hidden ? "legendonly" : true,
      line: {color: colour(s.colour), width: 1.6}, marker: {size: s.size, symbol: s.symbol, color: colour(s.colour), opacity: .8}};
    if (s.is_filled) Object.assign(drawn, {fill: "toself", fillcolor: colour(s.colour) + "30"});
    if (s.error) drawn.error_x = {type: "data", array: column(s.error, s.group), color: colour(s.colour), thickness: 2, width: 0};
    if (s.colour_by) {
      const values = column(s.colour_by, s.group), most = Math.max(...values.filter(v => v !== null).map(Math.abs));
      Object.assign(drawn.marker, {color: values, cmin: -most, cmax: most, showscale: true, opacity: 1,
        colorscale: [[0, colour("blue")], [.5, colour("soft")], [1, colour("red")]], colorbar: {thickness: 10, outlinewidth: 0}});
    }
    const where = (chart.names.length ? "" : "<br>%{y:.4g}") + "<br>" + (titleOf(chart.x, xName(s)) || "") + " %{x:.4g}";
    Object.assign(drawn, s.is_filled ? {hoverinfo: "skip"} : {text: s.texts, hovertemplate: (s.texts.length ? "%{text}" : s.name) + where + "<extra></extra>"});
    return drawn;
  };
  const diagonal = () => {
    const all = [...column(choice.x), ...column(choice.y)].filter(v => v !== null && v > 0), ends = [Math.min(...all), Math.max(...all)];
    return {x: ends, y: ends, mode: "lines", showlegend: false, hoverinfo: "skip", line: {color: colour("soft"), width: 1, dash: "dot"}};
  };
  const draw = () => {
    const gap = .08, height = (1 - gap * (panels - 1)) / panels;
    const type = choice.scale, shown = {};
    for (let i = 0; i < panels; i++) {
      const top = 1 - i * (height + gap), title = chart.is_y_chosen ? titleOf(chart.y, choice.y) : chart.y[i][1];
      shown["yaxis" + (i ? i + 1 : "")] = axis(panels > 1 ? "" : title, {domain: [Math.max(top - height, 0), top], automargin: true,
        ...(chart.has_diagonal ? {type} : {}), ...(chart.is_map ? {scaleanchor: "x", scaleratio: 1} : {}),
        ...(chart.names.length ? {tickvals: chart.names.map((_, k) => k), ticktext: chart.names, range: [chart.names.length - .5, -.5], showgrid: false} : {zeroline: true, zerolinecolor: colour("soft")})});
      if (panels > 1) (shown.annotations = shown.annotations || []).push({text: title, xref: "paper", yref: "paper", x: 0, y: top,
        showarrow: false, xanchor: "left", yanchor: "bottom", font: {size: 12, color: colour("soft")}});
    }
    const range = chart.x_range && choice.x === chart.x[0][0] ? (type === "log" ? chart.x_range.map(Math.log10) : chart.x_range) : undefined;
    shown.xaxis = axis(titleOf(chart.x, choice.x), {type, anchor: "y" + (panels > 1 ? panels : ""), exponentformat: "power",
      ...(range ? {range} : {}), ...(type === "linear" && !chart.is_map ? {zeroline: true, zerolinecolor: colour("soft")} : {})});
    const narrow = place.clientWidth < 500 && chart.names.length;
    if (narrow) shown.yaxis.ticktext = chart.names.map(name => name.replace(" with ", "<br>"));
    Plotly.react(place, [...chart.series.map(trace), ...(chart.has_diagonal ? [diagonal()] : [])], layout({height: chart.height_px, ...shown}),
      {...config, scrollZoom: chart.is_map});
  };
  choose(chart.is_y_chosen ? "across" : "along", chart.x, "x");
  if (chart.is_y_chosen) choose("up", chart.y, "y");
  if (chart.x_type === "log" || chart.has_diagonal) choose("scale", [["log", "logarithmic"], ["linear", "linear"]], "scale");
  draw();
  skidloc.onTheme(draw);
});

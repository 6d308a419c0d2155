"""What all reports have in common: the page around the parts, its style sheet, sections and figures, and how it gets onto the disk."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

from localization.errors import OutputError
from localization.report.runs import Line
from localization.report.svg import COLOURS, DARK_COLOURS, NARROW, WIDE

_PAPER = {"paper": "#ffffff", "card": "#f6f7f8", "accent": "#005a8c"}
_DARK_PAPER = {"paper": "#14171a", "card": "#1d2125", "accent": "#7cc4f5"}

_RULES = """
*{box-sizing:border-box}
html{-webkit-text-size-adjust:100%}
body{margin:0;background:var(--paper);color:var(--ink);font:16px/1.55 system-ui,-apple-system,"Segoe UI",Roboto,"DejaVu Sans",sans-serif}
main{max-width:62rem;margin:0 auto;padding:1.5rem 1rem 3rem}
h1{font-size:1.55rem;line-height:1.25;margin:0;overflow-wrap:anywhere}
h2{font-size:1.15rem;margin:2.4rem 0 .6rem}
p{margin:.5rem 0;max-width:46rem}
small,figcaption,.facts{color:var(--soft);font-size:.86rem}
.facts{margin:.35rem 0 0;overflow-wrap:anywhere}
.verdict{font-size:1.12rem;line-height:1.5;border-left:4px solid var(--accent);background:var(--card)}
.verdict p{max-width:none;margin:.3rem 0}
.verdict{padding:.6rem 1rem;margin:1.2rem 0;max-width:none}
figure{margin:0}
figure+.scroll{margin-top:1.2rem}
figcaption{max-width:46rem;margin-top:.4rem}
figure>svg{display:block;width:100%;height:auto}
figure>svg text{font-family:inherit!important}
.narrow{display:none!important}
.scroll{overflow-x:auto;border-top:1px solid var(--rule);border-bottom:1px solid var(--rule)}
table{border-collapse:collapse;font-size:.92rem;font-variant-numeric:tabular-nums;min-width:100%}
th,td{padding:.4rem .7rem;text-align:right;vertical-align:top;border-bottom:1px solid var(--rule);font-weight:400;white-space:nowrap}
thead th{vertical-align:bottom;font-weight:600;white-space:normal;min-width:5rem}
tbody tr:last-child>*{border-bottom:0}
th:first-child,td:first-child{text-align:left;padding-left:0;position:sticky;left:0;background:var(--paper)}
.bar{display:block;height:4px;margin:3px 0 0 auto;min-width:2px}
.name{white-space:nowrap}
.badge{background:var(--accent);color:var(--paper);border-radius:3px;padding:0 .35rem;font-size:.75rem;vertical-align:.1em}
.badge{white-space:nowrap}
.badge.soft{background:none;color:var(--accent);box-shadow:inset 0 0 0 1px}
.swatch{width:30px;height:8px;margin-right:.45rem;vertical-align:.12em}
.legend{display:flex;flex-wrap:wrap;gap:.15rem 1.1rem;margin:.2rem 0 .5rem;padding:0;list-style:none;font-size:.9rem}
.legend input{accent-color:var(--accent);margin:0 .4rem 0 0;vertical-align:-.1em}
.legend label{cursor:pointer;white-space:nowrap}
.ring{width:9px;height:9px;border:1.6px solid var(--ink);border-radius:50%;display:inline-block;margin-right:.45rem}
code{font-size:.92em}
summary{cursor:pointer;color:var(--accent);font-size:.9rem;margin:.6rem 0}
.dots{width:24px;height:8px;display:inline-block;margin-right:.45rem;background:#767d84;opacity:.8}
dl{display:grid;grid-template-columns:minmax(7rem,max-content) 1fr;gap:.2rem 1rem;margin:.5rem 0;font-size:.92rem}
dt{color:var(--soft)}
dd{margin:0;overflow-wrap:anywhere}
.terms{grid-template-columns:minmax(3.5rem,max-content) 1fr;max-width:50rem}
.terms dt{color:var(--ink);font-weight:600}
ul{padding-left:1.2rem;margin:.5rem 0}
li{overflow-wrap:anywhere}
.legend li{overflow-wrap:normal}
@media (max-width:40rem){
.wide{display:none!important}.narrow{display:block!important}
main{padding:1rem .9rem 2rem}
.verdict{font-size:1.03rem}
thead th{min-width:4.2rem}th,td{padding:.4rem .5rem}
th:first-child{white-space:normal;max-width:9.5rem;padding-right:.4rem}code{font-size:.85em}
dl{grid-template-columns:minmax(5rem,36%) 1fr}.terms{grid-template-columns:1fr}.terms dd{margin-bottom:.5rem}
}
@media print{
.wide{display:block!important}.narrow{display:none!important}
body{font-size:10pt}main{max-width:none;padding:0}
h2{break-after:avoid}figure,tr,.verdict{break-inside:avoid}
.scroll{overflow:visible}th:first-child,td:first-child{position:static}
table,th small,td small{font-size:8pt}th,td{padding:.25rem .35rem}thead th{min-width:0}
.legend input{display:none}*{print-color-adjust:exact;-webkit-print-color-adjust:exact}
}
"""


def html_page(title: str, parts: Iterable[str], lines: Sequence[Line] = ()) -> str:
    """The whole page of its parts, of which empty ones are left out. It loads nothing and runs no script. ``lines``: those that a legend
    can hide."""
    body = "\n".join(part for part in parts if part)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        "<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; style-src 'unsafe-inline'; img-src data:\">\n"
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>\n{style_sheet(lines)}</style>\n</head>\n"
        f"<body>\n<main>\n{body}\n</main>\n</body>\n</html>\n"
    )


def opening(title: str, facts: str, sentences: Sequence[str]) -> list[str]:
    """What every report begins with: its title, one line of facts, and the verdict, its first sentence first."""
    first, rest = escape(sentences[0]), " ".join(map(escape, sentences[1:]))
    return [
        f"<h1>{escape(title)}</h1>",
        f'<p class="facts">{escape(facts)}</p>',
        f'<div class="verdict"><p><b>{first}</b></p><p>{rest}</p></div>',
    ]


def section(title: str, content: str) -> str:
    """Nothing at all where there is no ``content``."""
    return f"<section>\n<h2>{title}</h2>\n{content}\n</section>" if content else ""


def figure(legend: str, pictures: Sequence[str], title: str, caption: str) -> str:
    """``pictures``: the SVG for wide pages and the one for phones."""
    drawn = [
        svg.replace("<svg", f'<svg class="{size.name}" role="img" aria-label="{title}"', 1)
        for svg, size in zip(pictures, (WIDE, NARROW), strict=True)
    ]
    return f"<figure>\n{legend}{drawn[0]}\n{drawn[1]}\n<figcaption>{caption}</figcaption>\n</figure>"


def bullets(items: Iterable[str]) -> str:
    """A list of plain texts; "" if there are none."""
    listed = "".join(f"<li>{escape(item)}</li>" for item in items)
    return f"<ul>{listed}</ul>" if listed else ""


def glossary(terms: Iterable[tuple[str, str]]) -> str:
    """How to read a report."""
    return section("How to read this", '<dl class="terms">' + "".join(f"<dt>{term}</dt><dd>{text}</dd>" for term, text in terms) + "</dl>")


def write_new(path: str | Path, content: bytes) -> None:
    """Raises `OutputError` if there is such a file already or it cannot be written."""
    try:
        with open(path, "xb") as file:
            file.write(content)
    except FileExistsError as error:
        raise OutputError(f"'{path}' exists already. Remove it or choose another name.") from error
    except OSError as error:
        raise OutputError(f"'{path}' cannot be written: {error.strerror}.") from error


def style_sheet(lines: Sequence[Line]) -> str:
    """Light, dark and paper, and the rules by which a legend's box hides its line."""
    light, dark = _variables({**_PAPER, **COLOURS}), _variables({**_DARK_PAPER, **DARK_COLOURS})
    hide = "".join(
        f"body:has(#show-{n}:not(:checked)) .series-{n}{{display:none}}"
        f"body:has(#show-{n}:not(:checked)) label[for=show-{n}]{{opacity:.45;text-decoration:line-through}}\n"
        for n in (line.number for line in lines)
    )
    return (
        f":root{{color-scheme:light dark;{light}}}\n@media screen and (prefers-color-scheme:dark){{:root{{{dark}}}}}\n"
        f"{_RULES.strip()}\n{hide}"
    )


def _variables(colours: dict[str, str]) -> str:
    return "".join(f"--{name}:{value};" for name, value in colours.items())

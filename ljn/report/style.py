"""The page's style sheet: light and dark, from a phone's width up, with no font or file from elsewhere."""

_LIGHT = """
  color-scheme: light;
  --paper: #fbfaf8; --card: #ffffff; --ink: #1c1f24; --soft: #565d68; --rule: #dddad3; --strong: #8b8f97;
  --accent: #1d4f91; --tint: #eef3fa; --good: #14663f; --good-tint: #e3f3ea; --bad: #9e1c1c; --bad-tint: #fbe9e7;
  --c0: #1d5fb4; --c1: #c2410c; --c2: #0f766e; --c3: #7e3fb0; --c4: #8a6100; --c5: #b8186a; --c6: #475569;
  --c7: #4d7c0f;
"""
_DARK = """
  color-scheme: dark;
  --paper: #14161a; --card: #1b1e24; --ink: #e8e6e1; --soft: #a9afb9; --rule: #343941; --strong: #6f7681;
  --accent: #8fb8f0; --tint: #212a37; --good: #7fd6a5; --good-tint: #173024; --bad: #ff9c93; --bad-tint: #3a1d1c;
  --c0: #74aef5; --c1: #f79256; --c2: #4fc9bd; --c3: #c79bf0; --c4: #dcb44c; --c5: #f485b8; --c6: #a8b3c4;
  --c7: #a5cf5c;
"""

STYLE = (
    f"""
:root {{{_LIGHT}}}
@media (prefers-color-scheme: dark) {{ :root {{{_DARK}}} }}
"""
    + """
* { box-sizing: border-box; }
html { -webkit-text-size-adjust: 100%; }
body { margin: 0; background: var(--paper); color: var(--ink); font: 16px/1.55 system-ui, -apple-system, "Segoe UI",
  Roboto, "Helvetica Neue", sans-serif; }
main, header, footer { max-width: 70rem; margin: 0 auto; padding: 0 1.25rem; }
header { padding-top: 3rem; }
h1, h2, h3 { font-family: Charter, "Bitstream Charter", "Source Serif 4", Georgia, serif; line-height: 1.2;
  font-weight: 600; text-wrap: balance; }
h1 { font-size: clamp(1.8rem, 1.3rem + 2.2vw, 2.7rem); margin: .2rem 0 1rem; letter-spacing: -.01em;
  overflow-wrap: anywhere; }
h2 { font-size: 1.45rem; margin: 3.2rem 0 .9rem; padding-top: 1.1rem; border-top: 1px solid var(--rule); }
h3 { font-size: 1.1rem; margin: 1.8rem 0 .6rem; }
a { color: var(--accent); text-underline-offset: .15em; }
:focus-visible { outline: 2px solid var(--accent); outline-offset: 2px; }
.eyebrow { margin: 0; color: var(--soft); font-size: .85rem; letter-spacing: .06em; text-transform: uppercase; }
.facts { display: flex; flex-wrap: wrap; gap: .7rem 2.2rem; margin: 0 0 1.2rem; }
.facts div { min-width: 0; }
dt { color: var(--soft); font-size: .8rem; }
dd { margin: 0; overflow-wrap: anywhere; }
code, pre, .mono { font-family: ui-monospace, "SF Mono", "Cascadia Mono", Menlo, "DejaVu Sans Mono", monospace;
  font-size: .86em; }
pre { margin: 0; padding: .8rem 1rem; background: var(--card); border: 1px solid var(--rule); border-radius: 6px;
  white-space: pre-wrap; overflow-wrap: anywhere; }
.summary { list-style: none; margin: 1.4rem 0 0; padding: 0; }
.summary li { display: flex; flex-wrap: wrap; gap: .2rem .8rem; align-items: baseline; padding: .5rem 0;
  border-top: 1px solid var(--rule); }
.summary a { flex: 1 1 18rem; }
.badge { display: inline-block; padding: .05rem .55rem; border-radius: 99px; font-size: .84rem; background: var(--tint);
  color: var(--ink); }
.good { background: var(--good-tint); color: var(--good); }
.bad { background: var(--bad-tint); color: var(--bad); }
.alert { margin: 1.5rem 0 0; padding: .8rem 1rem; border-left: 4px solid var(--bad); background: var(--bad-tint);
  border-radius: 0 6px 6px 0; }
.alert h2 { margin: 0 0 .3rem; padding: 0; border: 0; font-size: 1.05rem; color: var(--bad); }
.alert ul { margin: 0; padding-left: 1.1rem; overflow-wrap: anywhere; }
.scroll { overflow-x: auto; margin: 0 0 .8rem; }
table { border-collapse: collapse; font-size: .94rem; font-variant-numeric: tabular-nums lining-nums;
  border-top: 2px solid var(--ink); border-bottom: 2px solid var(--ink); }
table.wide { min-width: 100%; }
caption { text-align: left; color: var(--soft); font-size: .85rem; padding-bottom: .4rem; }
th, td { padding: .38rem .75rem; text-align: right; white-space: nowrap; font-weight: 400; vertical-align: baseline; }
th:first-child, td:first-child { padding-left: .1rem; }
th[scope=row], td.text, th.text { text-align: left; }
thead th { color: var(--soft); font-size: .86rem; }
thead tr:last-child th { border-bottom: 1px solid var(--strong); }
th[scope=colgroup] { text-align: center; color: var(--ink); font-weight: 600; font-size: .92rem; }
th[scope=colgroup] span { display: block; border-bottom: 1px solid var(--rule); padding-bottom: .2rem; }
tbody tr + tr > * { border-top: 1px solid var(--rule); }
tbody + tbody { border-top: 1px solid var(--strong); }
.ours { font-weight: 600; }
.sd, .none, .thesis, .sub { color: var(--soft); font-weight: 400; }
.sub { display: block; font-size: .8rem; }
th .sub { white-space: normal; max-width: 15rem; }
.sub a { white-space: nowrap; }
@media (max-width: 40rem) {
  main, header, footer { padding-left: 1rem; padding-right: 1rem; }
  th, td { padding-left: .45rem; padding-right: .45rem; }
  th[scope=row] { white-space: normal; min-width: 9.5rem; overflow-wrap: anywhere; }
}
.word { color: var(--bad); font-weight: 600; }
.notes { color: var(--soft); font-size: .88rem; max-width: 46rem; padding-left: 0; list-style: none; margin: .6rem 0; }
.notes li { margin: .2rem 0; }
.order { margin: .8rem 0; }
details { margin: .6rem 0; }
summary { cursor: pointer; color: var(--accent); }
.charts { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 25rem), 1fr)); gap: 1.4rem;
  margin: 1.4rem 0; }
figure { margin: 0; }
figcaption { font-size: .9rem; font-weight: 600; margin-bottom: .3rem; overflow-wrap: anywhere; }
figcaption .sub { display: inline; }
.chart svg:not(.swatch) { display: block; width: 100%; max-width: 34rem; height: auto; }
svg text { fill: var(--soft); font-size: 12.5px; font-variant-numeric: tabular-nums; }
svg path { fill: none; }
svg .grid { stroke: var(--rule); }
svg .axis { stroke: var(--strong); }
.line .route { stroke: var(--c); stroke-width: 2; stroke-linejoin: round; stroke-linecap: round; }
.line .bar { stroke: var(--c); stroke-width: 1.5; }
.line circle { fill: var(--c); stroke: var(--c); stroke-width: 1.8; }
.dashed .route { stroke-dasharray: 5 5; }
.dashed circle { fill: var(--paper); }
.c0 { --c: var(--c0); } .c1 { --c: var(--c1); } .c2 { --c: var(--c2); } .c3 { --c: var(--c3); }
.c4 { --c: var(--c4); } .c5 { --c: var(--c5); } .c6 { --c: var(--c6); } .c7 { --c: var(--c7); }
.legend { display: flex; flex-wrap: wrap; gap: .15rem 1.1rem; margin: .4rem 0 0; padding: 0; list-style: none;
  font-size: .86rem; }
.swatch { width: 26px; height: 12px; margin-right: .4rem; vertical-align: -1px; }
.pictures { display: grid; gap: 2rem; }
.pictures img { display: block; width: 100%; max-width: 100%; height: auto; background: #fff;
  border: 1px solid var(--rule); border-radius: 6px; }
.shot { overflow-x: auto; }
.shot img { min-width: 40rem; }
footer { color: var(--soft); font-size: .85rem; margin-top: 3.5rem; padding-top: 1rem; padding-bottom: 3rem; }
@media print { details > * { display: block; } .scroll { overflow: visible; } }
"""
)

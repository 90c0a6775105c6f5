"""The page's style sheet. Two grounds, as the reader prefers; from phones to wide screens."""

from __future__ import annotations

from splatbench.report.svg import colors

STYLE = (
    """
:root{color-scheme:light dark;--ground:#fbfaf8;--panel:#fff;--ink:#1b1b1f;--quiet:#5f5f68;--line:#dcdad5;
--faint:#f1efea;--paper:#77777f;--accent:#9a5b00;--focus:#c77700;--shade:#00000014}
"""
    + colors(0)
    + """
@media (prefers-color-scheme:dark){:root{--ground:#17181b;--panel:#1f2125;--ink:#ececf0;--quiet:#a6a6b0;--line:#363840;
--faint:#24262b;--paper:#94949e;--accent:#f0b45a;--focus:#f0b45a;--shade:#00000060}
"""
    + colors(1)
    + """}
*{box-sizing:border-box}
html{scroll-padding-top:3.5rem;-webkit-text-size-adjust:100%}
body{margin:0;background:var(--ground);color:var(--ink);font:16px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,
"Helvetica Neue",Arial,sans-serif;font-feature-settings:"tnum","kern"}
h1,h2,h3,h4,p,ul,figure,fieldset{margin:0;padding:0;border:0}
ul{list-style:none}
a{color:inherit}
:focus-visible{outline:2px solid var(--focus);outline-offset:2px;border-radius:3px}
.unseen{position:absolute;width:1px;height:1px;overflow:hidden;clip-path:inset(50%);white-space:nowrap}
.skip{position:absolute;left:-999px}.skip:focus{left:8px;top:8px;z-index:9;background:var(--panel);padding:6px 12px}
.top,main,nav{max-width:1640px;margin:0 auto;padding-inline:clamp(14px,2.4vw,40px)}
.top{padding-block:clamp(28px,5vw,64px) 20px}
h1{font-size:clamp(1.7rem,1.1rem + 2.2vw,2.7rem);line-height:1.12;letter-spacing:-.02em;font-weight:650;
text-wrap:balance}
h2{font-size:clamp(1.25rem,1rem + 1vw,1.7rem);line-height:1.2;letter-spacing:-.012em;font-weight:640;
text-wrap:balance}
h3{font-size:1.05rem;font-weight:620}h4{font-size:.95rem;font-weight:580}
.about{max-width:74ch;color:var(--quiet);margin-top:.6rem}
.machines{margin-top:.8rem;font-size:.875rem;color:var(--quiet)}
.machines li{border-left:3px solid var(--line);padding-left:10px}.machines+p{font-size:.875rem;color:var(--accent)}
nav{position:sticky;top:0;z-index:5;background:var(--ground);display:flex;gap:4px;overflow-x:auto;padding-block:8px;
border-bottom:1px solid var(--line);scrollbar-width:none}
nav a{flex:none;padding:5px 11px;border-radius:999px;text-decoration:none;font-size:.9rem;color:var(--quiet)}
nav a:hover{background:var(--faint);color:var(--ink)}
section{padding-block:clamp(32px,4vw,60px);border-bottom:1px solid var(--line)}
section:last-child{border:0}
.scroller{position:relative;margin-top:20px;overflow-x:auto;border:1px solid var(--line);border-radius:10px;
background:var(--panel)}
.results{border-collapse:separate;border-spacing:0;width:100%;font-size:.86rem;font-variant-numeric:tabular-nums;
line-height:1.3}
.results th,.results td{padding:6px 7px;text-align:right;white-space:nowrap;font-weight:400}
.results thead th{color:var(--quiet);font-size:.78rem;font-weight:560;vertical-align:bottom}
.results thead tr:first-child th{padding-bottom:2px}.results thead tr:first-child th[colspan]{text-align:left}
.results thead tr:last-child th{padding-top:3px;border-bottom:1px solid var(--line)}
.results thead .name{border-bottom:1px solid var(--line)}
.results .name{text-align:left;position:sticky;left:0;z-index:1;background:var(--panel);white-space:normal;
min-width:min(150px,38vw);border-right:1px solid var(--line)}
.results tbody .name{font-weight:540}
.results tbody .symbol{margin:0 8px -2px 0;flex:none}
.results .few{display:block;font-size:.75rem;color:var(--accent);font-weight:400}
.results tbody .name>span{display:inline-block;vertical-align:top;max-width:calc(100% - 26px)}
.results tbody tr+tr>*{border-top:1px solid var(--faint)}
.results tbody tr[data-m]:hover>*,.results tr.lit>*{background:var(--faint)}
.results .block th{text-align:left;background:var(--faint);color:var(--ink);font-weight:600;padding-block:6px}
.results .block span{position:sticky;left:12px}
.results .first{border-left:1px solid var(--line)}.results .name+.first{border-left:0}
.results thead tr:first-child th+th{border-left:1px solid var(--line)}
.results thead tr:last-child th:first-child{border-left:0}
.results thead tr:first-child .name+th{border-left:0}
.results .best b{font-weight:720;box-shadow:inset 0 -2px var(--accent)}
.results .interval{display:block;font-size:.68rem;color:var(--quiet)}
.results .state{text-align:left;color:var(--quiet);font-style:italic;white-space:normal;min-width:240px}
.results td{vertical-align:top}.results .name{vertical-align:top}
.results.wide{font-size:.8rem}.results.wide th,.results.wide td{padding-inline:5px}
.results.wide .interval{font-size:.62rem}.results.wide .name{min-width:min(132px,38vw)}
.results thead tr:last-child th{white-space:normal}
.own{width:fit-content;max-width:100%;margin-top:12px}
.results.paper{width:auto}.results.paper th,.results.paper td{color:var(--paper);padding-block:3px}
.results.paper thead tr:first-child th+th{border-left:0;padding-bottom:3px}
.results.paper thead .name{font-style:italic;font-weight:480}.results.paper tbody .name{font-weight:400}
.results button{all:unset;cursor:pointer}
.results button:focus-visible{outline:2px solid var(--focus);
outline-offset:3px;border-radius:3px}
.results [aria-sort] button::after{content:"";display:inline-block;width:0;margin-left:0}
.results [aria-sort=ascending] button::after{content:"▴";width:auto;margin-left:4px;color:var(--accent)}
.results [aria-sort=descending] button::after{content:"▾";width:auto;margin-left:4px;color:var(--accent)}
.notes{margin-top:10px;font-size:.875rem;color:var(--quiet);max-width:110ch}
.notes summary{cursor:pointer;padding:4px 0}.notes ul{list-style:disc;padding-left:1.2em}
.notes li{margin:2px 0;overflow-wrap:anywhere}
.plots{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,600px),1fr));gap:28px 32px;margin-top:32px}
.plots figure{min-width:0}
figcaption{font-weight:600;font-size:.98rem;margin-bottom:8px}
.plots svg{display:block;max-width:100%;height:auto;width:100%}.wide svg{max-width:860px}
.narrow{display:none}
.lit-on .chart [data-m]:not(.lit){opacity:.18}.chart [data-m]{transition:opacity .12s}
.chart .joined .whisker{opacity:.4}
.gallery{margin-top:36px}
.gallery-head{display:flex;flex-wrap:wrap;align-items:center;gap:6px 16px}
.gallery-head p{flex-basis:100%;font-size:.875rem;color:var(--quiet);max-width:90ch}
.segments{display:inline-flex;border:1px solid var(--line);border-radius:8px;overflow:hidden;background:var(--panel)}
.segments label,.segments button{all:unset;padding:4px 12px;font-size:.84rem;cursor:pointer;color:var(--quiet);
min-height:24px;line-height:24px;text-align:center}
.segments>*+*{border-left:1px solid var(--line)}
.segments input{position:absolute;opacity:0;pointer-events:none}
.segments label:has(:checked),.segments [aria-pressed=true]{background:var(--ink);color:var(--ground)}
.segments :focus-visible,.segments label:has(:focus-visible){
outline:2px solid var(--focus);outline-offset:-2px;border-radius:7px}
.case{margin-top:22px}
.case-head{display:flex;flex-wrap:wrap;align-items:center;justify-content:space-between;gap:6px 14px;margin-bottom:8px}
.tiles{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(46%,148px),1fr));gap:14px 10px}
.tiles a{display:block;overflow:hidden;border-radius:6px;background:var(--faint);cursor:zoom-in}
.tiles img{display:block;width:100%;height:auto;aspect-ratio:1;object-fit:contain;transform:scale(var(--zoom,1));
transform-origin:var(--x,50%) var(--y,50%)}
.sharp img{image-rendering:pixelated}
.tiles .error{display:none}
.gallery:has([value=error]:checked) li:not(.no-error) .error{display:block}
.gallery:has([value=error]:checked) li:not(.no-error) .result{display:none}
.tiles p{display:flex;gap:6px;align-items:baseline;font-size:.82rem;line-height:1.3;margin-top:5px}
.tiles .symbol{flex:none;transform:translateY(2px)}.tiles p span{overflow-wrap:anywhere;min-width:0}
.tiles b{font-weight:620;font-variant-numeric:tabular-nums;white-space:nowrap}
dialog{border:1px solid var(--line);border-radius:12px;padding:0 0 10px;background:var(--panel);color:var(--ink);
max-width:96vw;max-height:96vh;width:fit-content;box-shadow:0 20px 60px var(--shade)}
dialog::backdrop{background:#0009}
.bar{display:flex;flex-wrap:wrap;gap:8px 12px;align-items:center;padding:10px 14px}
.bar label{display:flex;gap:6px;align-items:center;font-size:.84rem;color:var(--quiet)}
.bar h3{flex:1 1 100%;font-size:.95rem;padding-right:40px}
.bar select,.bar .plain{font:inherit;font-size:.88rem;color:var(--ink);background:var(--ground);
border:1px solid var(--line);border-radius:6px;padding:4px 8px;max-width:min(260px,40vw);min-height:32px}
.bar .plain{cursor:pointer}.bar .close{position:absolute;right:10px;top:8px;border:0;background:none;font-size:1.3rem;
line-height:1;cursor:pointer;color:var(--ink);width:34px;height:34px}
.stage{position:relative;overflow:hidden;width:min(92vw,calc(96vh - 210px),1100px);aspect-ratio:1;margin:0 auto;
background:var(--faint);cursor:ew-resize;touch-action:none;user-select:none}
.stage>*{position:absolute;inset:0}
.stage img{width:100%;height:100%;object-fit:contain;transform:scale(var(--zoom,1));
transform-origin:var(--x,50%) var(--y,50%);pointer-events:none}
.stage .over{clip-path:inset(0 0 0 var(--wipe,50%))}
.stage .edge{inset:0 auto 0 var(--wipe,50%);width:2px;margin-left:-1px;background:#fff;box-shadow:0 0 0 1px #0008}
.stage .side{inset:8px auto auto 8px;background:#000a;color:#fff;font-size:.78rem;padding:1px 8px;border-radius:4px;
max-width:45%}
.stage .side+.side{inset:8px 8px auto auto}
.wipe{display:block;width:min(92vw,calc(96vh - 210px),1100px);margin:8px auto 0;accent-color:var(--focus)}
.hint{font-size:.78rem;color:var(--quiet);padding:4px 14px 2px}
kbd{font:inherit;border:1px solid var(--line);border-bottom-width:2px;border-radius:4px;padding:0 5px}
@media (max-width:720px){.wide{display:none}.narrow{display:block}.narrow svg{max-width:440px}
.results{font-size:.84rem}.results th,.results td{padding:6px 9px}.results .name{min-width:112px;max-width:34vw}
.hint{display:none}.tiles{gap:12px 8px}}
@media (prefers-reduced-motion:no-preference){html{scroll-behavior:smooth}}
@media print{nav,.case-head .segments,.gallery-head fieldset{display:none}section{break-inside:avoid-page}}
"""
)

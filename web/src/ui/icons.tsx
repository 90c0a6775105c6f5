/** Line icons on a 24 x 24 grid. */

const PATHS = {
  orbit: "M12 4a8 8 0 1 0 8 8M20 4v5h-5M12 9.5a2.5 2.5 0 1 0 0 5 2.5 2.5 0 0 0 0-5",
  brush: "M20 4 10.5 13.5M9 13c-2.5 0-4 1.8-4 4 0 1.5-.7 2.4-2 3 4.5.6 8-.7 8-4.2 0-1.7-.8-2.8-2-2.8M20 4l-7.5 11",
  erase: "M9 20h11M5.5 16.5l9-9a2 2 0 0 1 2.8 0l2.2 2.2a2 2 0 0 1 0 2.8L12 20H9zM10 12l5 5",
  fill: "M5 11.5 12 4.5l7 7-7 7zM5 11.5h14M20.5 16s1.5 2 1.5 3a1.5 1.5 0 0 1-3 0c0-1 1.5-3 1.5-3M9 7.5 6.5 5",
  line: "M5 19 19 5M5 19h.01M19 5h.01",
  text: "M5 7V5h14v2M12 5v14M9 19h6",
  stamp: "M4 5h16v14H4zM4 16l5-5 4 4 3-3 4 4M15.5 9.5h.01",
  clone: "M9 9h10v10H9zM5 15V5h10",
  heal: "M7.5 16.5a4 4 0 0 1 0-5.7l3.3-3.3a4 4 0 0 1 5.7 5.7l-3.3 3.3a4 4 0 0 1-5.7 0M9.5 9.5l5 5M12 10.5v3M10.5 12h3",
  pick: "M13 7l4 4M4 20l1-4 8.5-8.5 3 3L8 19zM14.5 5.5l1-1a2 2 0 0 1 2.8 0l1.2 1.2a2 2 0 0 1 0 2.8l-1 1",
  select: "M4 8V4h4M16 4h4v4M20 16v4h-4M8 20H4v-4",
  swap: "M7 4 4 7l3 3M4 7h13v13M14 17l3 3 3-3",
  front: "M3 12h9M8 8l4 4-4 4M15 5h6v14h-6z",
  home: "M4 11.5 12 5l8 6.5M6.5 10v9h11v-9",
  undo: "M8 5 4 9l4 4M4 9h10a6 6 0 0 1 0 12h-3",
  redo: "M16 5l4 4-4 4M20 9H10a6 6 0 0 0 0 12h3",
  eye: "M2.5 12S6 5.5 12 5.5 21.5 12 21.5 12 18 18.5 12 18.5 2.5 12 2.5 12M12 9a3 3 0 1 0 0 6 3 3 0 0 0 0-6",
  hidden:
    "M4 4l16 16M9.5 6a9 9 0 0 1 2.5-.5c6 0 9.5 6.5 9.5 6.5a17 17 0 0 1-2.8 3.5M6 8a17 17 0 0 0-3.5 4S6 18.5 12 18.5a9 9 0 0 0 3.5-.7",
  bin: "M5 7h14M9 7V4h6v3M7 7l1 13h8l1-13M10.5 11v5M13.5 11v5",
  copy: "M9 9h11v11H9zM5 15H4V4h11v1",
  merge: "M12 3v11M8 10l4 4 4-4M5 19h14",
  mask: "M4 5h16v14H4zM12 8a4 4 0 1 0 0 8 4 4 0 0 0 0-8",
  plus: "M12 5v14M5 12h14",
  minus: "M5 12h14",
  close: "M6 6l12 12M18 6 6 18",
  help: "M9 9.5a3 3 0 1 1 4.5 2.6c-1 .6-1.5 1.1-1.5 2.4M12 18h.01",
  frame: "M4 9V4h5M15 4h5v5M20 15v5h-5M9 20H4v-5M12 9.5a2.5 2.5 0 1 0 0 5 2.5 2.5 0 0 0 0-5",
  turn: "M12 3v18M7 8l5-5 5 5M7 16l5 5 5-5",
  grid: "M4 4h16v16H4zM4 9.3h16M4 14.7h16M9.3 4v16M14.7 4v16",
  compare: "M12 3v18M4 6h5M4 18h5V6M4 6v12M15 6h5v12h-5",
  lens: "M12 4a8 8 0 1 0 0 16 8 8 0 0 0 0-16M12 4v8l5.6 5.6",
  coverage: "M4 12a8 8 0 0 1 16 0M4 12h16M8 16h8M10 20h4",
  camera: "M4 8h3l2-3h6l2 3h3v11H4zM12 10a3.5 3.5 0 1 0 0 7 3.5 3.5 0 0 0 0-7",
  save: "M5 4h11l3 3v13H5zM8 4v5h7V4M8 20v-6h8v6",
  open: "M3 19V5h6l2 3h9v3M3 19l3-8h16l-3 8z",
  share: "M12 15V4M8 8l4-4 4 4M5 13v7h14v-7",
  lock: "M6 11h12v9H6zM9 11V8a3 3 0 0 1 6 0v3",
  drag: "M9 6h.01M15 6h.01M9 12h.01M15 12h.01M9 18h.01M15 18h.01",
  check: "M5 12.5l4.5 4.5L19 7.5",
  panels: "M4 5h16v14H4zM14.5 5v14",
  sun: "M12 8a4 4 0 1 0 0 8 4 4 0 0 0 0-8M12 2.5V5M12 19v2.5M2.5 12H5M19 12h2.5M5.3 5.3 7 7M17 17l1.7 1.7M18.7 5.3 17 7M7 17l-1.7 1.7",
  film: "M4 5h16v14H4zM8 5v14M16 5v14M4 12h16",
  batch: "M4 4h7v7H4zM13 4h7v7h-7zM4 13h7v7H4zM16.5 13.5v6M13.5 16.5h6",
  next: "M5 12h13M13 6l6 6-6 6",
} as const;

export type IconName = keyof typeof PATHS;

export function Icon({ name, size = 18 }: { name: IconName; size?: number }) {
  return (
    <svg
      width={size}
      height={size}
      viewBox="0 0 24 24"
      fill="none"
      stroke="currentColor"
      stroke-width="1.7"
      stroke-linecap="round"
      stroke-linejoin="round"
      aria-hidden="true"
    >
      <path d={PATHS[name]} />
    </svg>
  );
}

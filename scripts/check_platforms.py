"""pyright for the systems that this machine is not: python scripts/check_platforms.py

Only files that use what differs between systems are looked at (the modules below, but for the parts of `os` that all of
them have): a third of the time, and the rest of the code cannot give another answer.
"""

from __future__ import annotations

import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SYSTEMS = {"linux": "Linux", "darwin": "Darwin", "win32": "Windows"}
EVERYWHERE = {
    "os": "environ|path|pathsep|sep|fspath|PathLike|getpid|devnull|replace|access|cpu_count|W_OK|X_OK|listdir|scandir"
    "|DirEntry|urandom|utime|stat|fstat|fsync|open|read|write|fdopen|close|dup2?|pipe|link|SEEK_END|O_RDONLY|O_WRONLY|name"
    "|kill|abort|_exit|system|mkdir|makedirs|getcwd|strerror|waitpid",
    "signal": "signal|getsignal|default_int_handler|Signals|SIGINT|SIGTERM|SIG_IGN|SIG_DFL",
    # methods as well: sockets are often called so
    "socket": "socket|create_connection|gethostname|AF_INET6?|SOCK_STREAM|SOL_SOCKET|SO_REUSEADDR|SO_RCVBUF|IPPROTO_TCP"
    "|accept|send|recv|close|setsockopt|settimeout|send_bytes|send_text|receive_text",
}
"""Module -> what it has on every system, with the same types."""
DIFFERS = re.compile(
    "|".join(rf"\b{module}\.(?!({names})\b)[a-zA-Z_]" for module, names in EVERYWHERE.items())
    + r"|\bsys\.platform\b|\bsubprocess\.[A-Z][A-Z_]+\b(?<!PIPE)(?<!DEVNULL)(?<!STDOUT)"
    r"|\basyncio\.\w*(EventLoop|Policy|Watcher|Pipe|unix|Iocp)|\bmmap\.[a-zA-Z_]|\bselect\.(\w*poll|k(queue|event))"
    r"|\bctypes\.(win|Win|WIN|ole|Ole|HRESULT|FormatError|\w+_last_error|pythonapi)|\btime\.(clock_|tzset|pthread)"
    r"|^\s*(import|from) (fcntl|resource|pwd|grp|termios|tty|pty|msvcrt|winreg|_winapi|syslog)\b"
    r"|^\s*from (os|sys|signal|socket|asyncio|mmap|select|ctypes) import ",
    re.MULTILINE,
)


def files() -> list[Path]:
    """Those whose types may depend on the system."""
    every = sorted(
        [
            *(ROOT / "src").rglob("*.py"),
            *(ROOT / "train").rglob("*.py"),
            *(ROOT / "benchmarks").rglob("*.py"),
            *(ROOT / "tests").rglob("*.py"),
        ]
    )
    return [path for path in every if DIFFERS.search(path.read_text(encoding="utf-8"))]


def check(system: str) -> tuple[str, int, str]:
    """(system, exit code, what pyright said)."""
    command = [sys.executable, "-m", "pyright", "--pythonplatform", system, *map(str, files())]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, encoding="utf-8", errors="replace", check=False)
    return system, done.returncode, done.stdout + done.stderr


def main() -> int:
    """1 where one of them finds something."""
    systems = [name for platform, name in SYSTEMS.items() if platform != sys.platform]
    with ThreadPoolExecutor(len(systems)) as pool:
        results = list(pool.map(check, systems))
    for system, code, text in results:
        print(f"pyright for {system}, {len(files())} files: {text.strip().splitlines()[-1] if not code else text}")
    return max(code for _, code, _ in results)


if __name__ == "__main__":
    sys.exit(main())

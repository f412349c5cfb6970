"""A pytest plugin that prints something while no test ends."""

from threading import Event, Thread
from typing import Any

import pytest


class SignOfLife:
    """Plugin that prints a tilde whenever no test has ended for some seconds.

    Args:
        config: pytest's configuration, with the reporter that prints.
        seconds: Time between two tildes.
    """

    def __init__(self, config: Any, seconds: float = 8.0) -> None:
        self.config = config
        self.seconds = seconds
        self.has_news = Event()
        self.is_over = False

    def pytest_report_header(self) -> str:
        return f"~ means that no test has ended for {self.seconds:.0f} s"

    @pytest.hookimpl(trylast=True)
    def pytest_sessionstart(self) -> None:
        Thread(target=self.watch, daemon=True).start()

    def pytest_runtest_logreport(self) -> None:
        self.has_news.set()

    def pytest_sessionfinish(self) -> None:
        self.is_over = True
        self.has_news.set()

    def watch(self) -> None:
        reporter = self.config.pluginmanager.get_plugin("terminalreporter")
        while not self.is_over:
            if not self.has_news.wait(self.seconds):
                reporter.write("~", flush=True)
            self.has_news.clear()

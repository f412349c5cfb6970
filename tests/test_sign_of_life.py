"""The sign of life is printed while no test ends, and only then."""

import time
from threading import Thread
from unittest.mock import MagicMock

from tests.sign_of_life import SignOfLife


def test_a_silence_is_filled_and_the_end_ends_the_thread() -> None:
    config = MagicMock()
    write = config.pluginmanager.get_plugin.return_value.write
    plugin = SignOfLife(config, seconds=0.01)
    thread = Thread(target=plugin.watch)
    thread.start()
    while write.call_count < 2:
        time.sleep(0.01)
    plugin.pytest_sessionfinish()
    thread.join()
    write.assert_called_with("~", flush=True)


def test_a_test_that_ends_postpones_the_sign() -> None:
    config = MagicMock()
    plugin = SignOfLife(config, seconds=3600.0)
    thread = Thread(target=plugin.watch)
    thread.start()
    plugin.pytest_runtest_logreport()
    plugin.pytest_sessionfinish()
    thread.join()
    config.pluginmanager.get_plugin.return_value.write.assert_not_called()

"""What a rig sends, as the page's tests need it."""

import pytest
from vical_mocks.harness import web_feed


@pytest.fixture(scope="session", name="web_feed")
def web_feed_module():
    return web_feed

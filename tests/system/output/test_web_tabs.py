"""Tabs of several cameras in a real browser."""

import pytest

pytestmark = pytest.mark.system

LONG = "front_left_global_shutter_stereo_camera_with_a_very_long_name_2"


def test_a_camera_without_pictures_does_not_show_those_of_another(fed, browser):
    """The last picture of the other camera stayed, with its corners, as 'no new picture'."""

    async def script(page):
        await page.open(fed.address, 390, 844)
        await page.wait("camera.last && document.querySelector('.screen').classList.contains('live')")
        await page.evaluate(f"page.latest.{LONG} = page.latest.cam0; draw(); $('tabs').lastChild.click()")
        wide = await page.evaluate("document.documentElement.scrollWidth")
        shown = await page.evaluate(
            "[page.camera, $('nopicture').textContent, $('corners').children.length, $('misfit').textContent,"
            " document.querySelector('.screen').classList.contains('live'),"
            " $('picture').getContext('2d').getImageData(0, 0, 640, 480).data.some((v) => v > 0)]"
        )
        await page.evaluate("$('tabs').firstChild.click()")
        await page.wait("document.querySelector('.screen').classList.contains('live')")
        return wide, shown, page.errors

    wide, shown, errors = browser.drive(script)
    assert shown == [LONG, "no image yet", 0, "", False, False]
    assert wide <= 390  # a long name is broken
    assert errors == []

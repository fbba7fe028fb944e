"""Marks on the page: pointer, touch and keyboard, and the same mask and hints as on the command
line.
"""

import math

import numpy as np
import pytest
from onnx import helper

from brewster import Photo
from cli_helpers import image_bytes, write_onnx
from page_helpers import canvas, downloaded, settle, upload
from web_servers import serve_process

SIZE = 300, 200


@pytest.fixture
def page(open_page):
    page = open_page()
    upload(page, ("window.png", image_bytes(*SIZE, "png")))
    return page


def drag(page, start, end):
    """Drags the mouse between two points of the photo, given in its pixels."""
    points = [screen_point(page, point) for point in (start, end)]
    page.mouse.move(*points[0])
    page.mouse.down()
    page.mouse.move(*points[1], steps=8)
    page.mouse.up()
    settle(page)


def screen_point(page, point):
    stage = page.locator("glass-compare").bounding_box()
    scale = min(stage["width"] / SIZE[0], stage["height"] / SIZE[1], 2)
    corner = (
        stage[side] + (stage[length] - scale * size) / 2
        for side, length, size in zip("xy", ("width", "height"), SIZE, strict=True)
    )
    return [edge + scale * at for edge, at in zip(corner, point, strict=True)]


def saved_mask(page):
    name, data = downloaded(page, page.get_by_role("button", name="Save the marks").click)
    assert name == "window.mask.png"
    mask = Photo.open(data)
    assert (mask.size, mask.pixels.shape[2], mask.file_info.bits) == (SIZE, 1, 8)
    return data, mask.pixels[..., 0]


def set_slider(page, name, value):
    page.get_by_label(name, exact=True).fill(str(value))


def test_a_protected_rectangle_stays_the_photo_and_the_command_line_makes_the_same_bytes(
    page, run, tmp_path
):
    page.get_by_label("Leave as it is").check()
    page.get_by_label("Rectangle").check()
    set_slider(page, "Feather", 0)
    drag(page, (60, 50), (150, 120))
    mask, values = saved_mask(page)
    assert not values[54:116, 64:146].any()
    outside = np.ones_like(values, bool)
    outside[46:124, 56:154] = False
    assert (values[outside] == 255).all()

    photo = canvas(page, "left")
    shown = canvas(page, "right")
    assert (shown[54:116, 64:146] == photo[54:116, 64:146]).all()
    assert (shown[outside] != photo[outside]).any()
    _, made = downloaded(page, page.get_by_role("button", name="Download transmission").click)
    (tmp_path / "mask.png").write_bytes(mask)
    data = image_bytes(*SIZE, "png")
    assert made == run("-", "--mask", "mask.png", stdin=data)[1]
    assert (
        Photo.open(made).pixels[54:116, 64:146] == Photo.open(data).pixels[54:116, 64:146]
    ).all()


def test_the_edge_of_a_stroke_is_smooth(page):
    page.get_by_label("Leave as it is").check()
    set_slider(page, "Brush size", 0.1)
    set_slider(page, "Feather", 0.04)
    drag(page, (80, 100), (220, 100))
    _, values = saved_mask(page)
    assert values[100, 80:220].max() == 0
    assert values[:70].min() == 255
    edge = values[70:100, 150].astype(int)  # from outside to inside
    assert (np.diff(edge) <= 0).all()
    assert len(np.unique(edge)) > 8  # 12 pixels wide
    radius = 0.05 * SIZE[0]
    assert abs(edge[round(30 - radius)] - 128) <= 16  # half on the edge of the brush


def test_strength_and_reset_are_undone_and_redone_like_marks(page):
    page.get_by_label("Leave as it is").check()
    drag(page, (60, 60), (120, 60))
    strength = page.get_by_label("Strength", exact=True)
    strength.focus()
    for _ in range(3):
        page.keyboard.press("ArrowLeft")
    settle(page)
    shown = canvas(page, "right")
    page.get_by_role("button", name="Reset").click()
    amounts = []
    for keys in ("Control+z", "Control+z", "Control+z", "Control+z", "Control+y"):
        page.keyboard.press(keys)
        amounts.append(page.locator("#amount").inner_text())
        settle(page)
        if len(amounts) == 1:
            assert (canvas(page, "right") == shown).all()
    assert amounts == ["97 %", "98 %", "99 %", "100 %", "99 %"]


def test_the_eraser_and_undo_and_redo_restore_the_mask(page):
    page.get_by_label("Leave as it is").check()
    drag(page, (60, 60), (120, 60))
    _, first = saved_mask(page)
    page.get_by_label("Eraser").check()
    set_slider(page, "Brush size", 0.3)
    drag(page, (40, 60), (140, 60))
    _, erased = saved_mask(page)
    assert erased.min() > 250 > first.min() == 0
    page.keyboard.press("Control+z")
    assert (saved_mask(page)[1] == first).all()
    page.get_by_role("button", name="Redo").click()
    assert (saved_mask(page)[1] == erased).all()
    for _ in range(2):
        page.get_by_role("button", name="Undo", exact=True).click()
    assert page.get_by_role("button", name="Undo", exact=True).is_disabled()
    assert page.get_by_role("button", name="Save the marks").is_disabled()
    page.keyboard.press("Control+y")
    page.get_by_role("button", name="Clear").click()
    assert page.get_by_role("button", name="Save the marks").is_disabled()


def test_regions_are_drawn_with_the_keyboard(page):
    page.get_by_label("Leave as it is").check()
    page.get_by_label("Rectangle").check()
    page.locator("glass-compare").focus()
    page.keyboard.press("Space")  # in the middle of the photo
    for key in ("Shift+ArrowRight", "Shift+ArrowDown", "ArrowDown"):
        page.keyboard.press(key)
    page.keyboard.press("Space")
    _, values = saved_mask(page)
    assert not values[105:112, 155:160].any()
    assert values[90, 150] == values[110, 180] == 255
    page.locator("glass-compare").focus()
    page.keyboard.press("Space")
    page.keyboard.press("Shift+ArrowLeft")
    page.keyboard.press("Escape")
    assert (saved_mask(page)[1] == values).all()


def test_regions_are_drawn_with_a_finger_and_two_fingers_zoom(open_page):
    page = open_page(viewport={"width": 390, "height": 844}, has_touch=True)
    upload(page, ("window.png", image_bytes(*SIZE, "png")))
    page.get_by_label("Leave as it is").check()
    finger = page.context.new_cdp_session(page)

    def touch(kind, *points):
        page.evaluate("scrollTo(0, 0)")
        stage = page.locator("glass-compare").bounding_box()
        at = [
            {"x": stage["x"] + x, "y": stage["y"] + y, "id": index}
            for index, (x, y) in enumerate(points)
        ]
        finger.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": at})

    touch("touchStart", (150, 150))
    touch("touchMove", (200, 170))
    touch("touchMove", (240, 180))
    touch("touchEnd")
    settle(page)
    view = Photo.open(page.locator("glass-compare").screenshot()).pixels.min(axis=2)
    assert np.median(view[169:173, 199:203]) < 150  # the tint stays visible without the finger
    _, values = saved_mask(page)
    assert values.min() == 0
    touch("touchStart", (150, 200))
    touch("touchStart", (150, 200), (250, 200))
    touch("touchMove", (100, 200), (300, 200))
    touch("touchEnd")
    assert (saved_mask(page)[1] == values).all()  # the second finger cancels the region
    assert "zoomed" in page.locator("glass-compare").get_attribute("class")


def amounts_in_list(page):
    """Returns the strength of each photo, and whether it has marks."""
    found = []
    for pick in page.locator(".pick").all():
        pick.click()
        page.wait_for_selector("glass-compare:not([hidden])")
        settle(page)
        has_marks = page.locator("#clear-marks").get_attribute("aria-disabled") == "false"
        found.append((page.locator("#amount").inner_text(), has_marks))
    page.locator(".pick").first.click()
    page.wait_for_selector("glass-compare:not([hidden])")
    settle(page)
    return found


def test_the_strength_is_copied_without_marks_and_one_undo_takes_it_back_in_all_photos(page):
    upload(page, ("other.png", image_bytes(80, 60, "png", 1)))
    upload(page, ("last.png", image_bytes(80, 60, "png", 2)))
    page.locator(".pick").first.click()
    page.get_by_label("Leave as it is").check()
    drag(page, (100, 60), (100, 60))
    set_slider(page, "Strength", 0.6)
    page.get_by_role("button", name="Copy to all photos").click()
    assert page.locator("#copied-text").inner_text() == "Copied to 2 other photos."
    assert amounts_in_list(page) == [("60 %", True), ("60 %", False), ("60 %", False)]
    page.locator(".pick").nth(2).click()
    page.wait_for_selector("glass-compare:not([hidden])")
    page.get_by_role("button", name="Undo", exact=True).click()
    assert amounts_in_list(page) == [("60 %", True), ("100 %", False), ("100 %", False)]
    assert not page.locator("#copied").is_visible()
    page.keyboard.press("Control+y")
    assert amounts_in_list(page) == [("60 %", True), ("60 %", False), ("60 %", False)]
    page.get_by_role("button", name="Undo copy").click()
    assert amounts_in_list(page) == [("60 %", True), ("100 %", False), ("100 %", False)]
    page.get_by_role("button", name="Reset", exact=True).click()
    assert amounts_in_list(page)[0] == ("100 %", True)  # Reset, too, changes only the strength


def test_marks_are_copied_to_photos_of_other_sizes_only_after_a_question(page):
    page.get_by_label("Leave as it is").check()
    drag(page, (100, 60), (100, 60))
    upload(page, ("other.png", image_bytes(600, 400, "png")))
    assert page.locator(".pick[aria-current]").get_attribute("title") == "other.png"
    page.locator(".pick").first.click()
    for answer in ("dismiss", "accept"):
        page.once("dialog", lambda dialog, answer=answer: getattr(dialog, answer)())
        page.get_by_role("button", name="Copy the marks").click()
        marked = [has_marks for _, has_marks in amounts_in_list(page)]
        assert marked == [True, answer == "accept"]
    page.locator(".pick").nth(1).click()
    page.wait_for_selector("glass-compare:not([hidden])")
    settle(page)
    _, data = downloaded(page, page.get_by_role("button", name="Save the marks").click)
    values = Photo.open(data).pixels[..., 0]
    assert values.shape == (400, 600)
    covered = (255 - values.astype(float)).sum() / 255
    radius = 0.05 * 600
    assert covered == pytest.approx(math.pi * radius**2, rel=0.1)
    page.keyboard.press("Control+z")
    assert [has_marks for _, has_marks in amounts_in_list(page)] == [True, False]


@pytest.fixture
def hint_page(chromium, tmp_path):
    """The page of a server whose model halves the light where the hint says reflection, and only
    there.
    """
    nodes = [
        helper.make_node("Slice", ["hints", "zero", "one", "one"], ["red"]),  # 0 to 1 of axis 1
        helper.make_node("Mul", ["red", "half"], ["share"]),
        helper.make_node("Mul", ["photo", "share"], ["reflection"]),
        helper.make_node("Sub", ["photo", "reflection"], ["transmission"]),
    ]
    constants = {"zero": np.array([0]), "one": np.array([1]), "half": np.array(0.5, np.float32)}
    model = write_onnx(tmp_path / "hinted.onnx", nodes, constants, hints=2)
    with serve_process("--model", model, "--token", "auto") as link:
        page = chromium.new_context(
            viewport={"width": 1100, "height": 760}, accept_downloads=True
        ).new_page()
        page.goto(link)
        page.wait_for_selector("#model option", state="attached")
        upload(page, ("window.png", image_bytes(*SIZE, "png")))
        yield page
        page.context.close()


def test_a_hint_separates_again_and_reaches_the_file_with_a_mask(
    hint_page, run_without_model, tmp_path
):
    page = hint_page
    assert (canvas(page, "left") == canvas(page, "right")).all()
    page.get_by_label("Mark as reflection").check()
    page.get_by_label("Rectangle").check()
    drag(page, (60, 50), (200, 150))
    page.wait_for_function("() => !document.querySelector('#photos .working, #photos .waiting')")
    settle(page)
    page.get_by_label("Leave as it is").check()
    drag(page, (140, 50), (220, 160))
    settle(page)
    _, made = downloaded(page, page.get_by_role("button", name="Download transmission").click)
    photo = canvas(page, "left")
    result = Photo.open(made).pixels
    shown = canvas(page, "right")
    for pixels in (result, shown):
        assert (
            pixels[80:120, 80:120].mean() < 0.85 * photo[80:120, 80:120].mean()
        )  # hint: half of the light
        assert (
            pixels[80:120, 150:190] == photo[80:120, 150:190]
        ).all()  # hint, but protected by the mask
        assert (pixels[170:, :] == photo[170:, :]).all()
    files = []
    page.on("download", lambda download: files.append(download))  # noqa: PLW0108  (playwright takes no builtin)
    page.get_by_role("button", name="Save the marks").click()
    while len(files) < 2:
        page.wait_for_timeout(20)
    for file in files:
        file.save_as(tmp_path / file.suggested_filename)
    assert sorted(file.suggested_filename for file in files) == [
        "window.hints.png",
        "window.mask.png",
    ]
    (tmp_path / "window.png").write_bytes(image_bytes(*SIZE, "png"))
    marks = ("--mask", tmp_path / "window.mask.png", "--hints", tmp_path / "window.hints.png")
    options = (
        *marks,
        "--model",
        tmp_path / "hinted.onnx",
        "--device",
        "cpu",
        "--layers",
        "transmission",
    )
    run_without_model(tmp_path / "window.png", *options)
    assert (tmp_path / "window.transmission.png").read_bytes() == made


def test_a_model_without_hints_offers_no_marks_for_them(page):
    assert not page.get_by_label("Mark as reflection").is_visible()
    assert page.get_by_label("Leave as it is").is_visible()


def wait_for_the_result(page):
    page.wait_for_function("() => !document.querySelector('#photos .working, #photos .waiting')")
    settle(page)


IS_RESULT_SHOWN = """([left, top, right, bottom]) => {
    const compare = document.querySelector("glass-compare");
    const mean = (canvas, from, to) => {
        const [width, height] = [to.x - from.x, to.y - from.y].map(Math.round);
        const pixels = canvas.getContext("2d").getImageData(from.x, from.y, width, height).data;
        return [0, 1, 2].map((channel) => pixels.filter((_, i) => i % 4 === channel)
            .reduce((sum, code) => sum + code, 0) / (width * height));
    };
    const width = compare.right.width;
    const from = compare.toView([left, top]);
    const shown = mean(compare.canvas, from, compare.toView([right, bottom]));
    const result = mean(compare.right, { x: left * width, y: top * width },
        { x: right * width, y: bottom * width });
    return shown.every((code, i) => Math.abs(code - result[i]) < 2);
}"""
"""Whether the view shows the result in an area, in fractions of the longer side of the photo."""


def test_a_stroke_ends_in_its_result_without_tint_and_nothing_moves(hint_page):
    page = hint_page
    page.get_by_label("Mark as reflection").check()
    assert page.get_by_label("Result", exact=True).is_checked()
    assert not page.get_by_role("slider", name="Line").is_visible()
    page.get_by_label("Rectangle").check()
    held = []
    page.route("**/preview?*", lambda route: held.append(route))  # noqa: PLW0108  (no builtin)
    before = page.locator("glass-compare").bounding_box()
    drag(page, (60, 50), (200, 150))
    page.wait_for_function("() => document.querySelector('#update-bar').checkVisibility()")
    area = [side / SIZE[0] for side in (100, 80, 140, 120)]
    assert not page.evaluate(IS_RESULT_SHOWN, area)  # under the tint
    assert page.locator("glass-compare").bounding_box() == before
    held[0].continue_()
    wait_for_the_result(page)
    page.wait_for_function(IS_RESULT_SHOWN, arg=area)
    assert page.locator("glass-compare").bounding_box() == before
    assert not page.locator("#stroke-note").is_visible()
    page.get_by_label("Eraser").check()
    page.mouse.move(*screen_point(page, (20, 20)))
    settle(page)
    assert not page.evaluate(IS_RESULT_SHOWN, area)  # so that one sees what can be erased
    page.get_by_label("Off").check()
    assert page.get_by_label("Slider", exact=True).is_checked()


def test_a_mark_as_reflection_that_changes_little_says_so_where_it_is(hint_page):
    page = hint_page
    page.get_by_label("Mark as reflection").check()
    page.get_by_label("Rectangle").check()
    drag(page, (60, 50), (200, 150))
    wait_for_the_result(page)
    assert not page.locator("#stroke-note").is_visible()
    drag(page, (80, 70), (150, 120))  # where the light is halved already
    page.wait_for_selector("#stroke-note", state="visible")
    note = page.locator("#stroke-note").bounding_box()
    x, y = screen_point(page, (150, 120))
    assert abs(note["x"] + note["width"] / 2 - x) < 2
    assert abs(note["y"] + note["height"] / 2 - y) < 2
    page.mouse.down()
    assert not page.locator("#stroke-note").is_visible()
    page.mouse.up()


def test_the_photo_is_shown_while_the_button_or_its_key_is_held_and_after_a_short_press(page):
    is_before = "document.querySelector('glass-compare').isBefore"
    page.get_by_role("button", name="Before").hover()
    shown = []
    for press, release in (
        (page.mouse.down, page.mouse.up),
        (lambda: page.keyboard.down("b"), lambda: page.keyboard.up("b")),
    ):
        press()
        shown.append(page.evaluate(is_before))
        page.wait_for_timeout(320)  # longer than a short press
        release()
        shown.append(page.evaluate(is_before))
    assert shown == [True, False] * 2
    page.keyboard.press("b")
    assert page.evaluate(is_before)
    page.get_by_role("button", name="Before").press("Enter")
    assert not page.evaluate(is_before)

"""The page, tested in a real browser with a real server."""

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from brewster import Photo
from cli_helpers import image_bytes
from page_helpers import canvas, difference, downloaded, settle, share, upload

MIXTURE = Path(__file__).parent / "pictures" / "mixture-coffee-rocket.jpg"


def test_a_photo_is_uploaded_compared_and_downloaded_as_by_the_command(
    open_page, run_without_model, tmp_path
):
    whole = Photo.open(MIXTURE)
    photo = tmp_path / "window.jpg"
    photo.write_bytes(Photo(whole.pixels[:150, :200].copy(), None, whole.file_info).encode())
    page = open_page()
    upload(page, (photo.name, photo.read_bytes()))
    page.get_by_label("Model").select_option("compact")
    page.wait_for_selector("li.done")
    assert (canvas(page, "left") == Photo.open(photo).pixels).all()

    stage = page.locator("glass-compare").bounding_box()
    page.mouse.move(stage["x"] + stage["width"] / 2, stage["y"] + 100)
    page.mouse.down()
    page.mouse.move(stage["x"] + stage["width"] / 4, stage["y"] + 120)
    page.mouse.up()
    assert share(page) < 40

    page.get_by_label("Strength", exact=True).fill("0.6")
    settle(page)
    assert page.locator("#amount").inner_text() == "60 %"
    run_without_model(
        photo, "--strength", "0.6", "--device", "cpu", "--layers", "transmission,confidence"
    )
    for layer in ("transmission", "confidence"):
        page.get_by_label(layer.capitalize(), exact=True).check()
        settle(page)
        (made,) = tmp_path.glob(f"*.{layer}.*")
        if layer == "transmission":  # the confidence is shown in colours
            shown = Photo.open(made).srgb_8bit()
            assert (
                np.median(difference(canvas(page, "right"), shown)) <= 1
            )  # JPEG differs more at edges
        name, data = downloaded(page, page.get_by_role("button", name=f"Download {layer}").click)
        assert (name, data) == (made.name, made.read_bytes())


def test_the_page_works_with_the_keyboard_only(open_page, run):
    data = image_bytes(90, 60, "png")
    file = {"name": "window.png", "mimeType": "image/png", "buffer": data}
    page = open_page()
    page.on("filechooser", lambda choosing: choosing.set_files(file))
    page.get_by_role(
        "button", name="Choose photos"
    ).wait_for()  # the handler above is then registered
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    page.wait_for_selector("li.done")
    page.wait_for_selector("glass-compare:not([hidden])")
    focus = (
        "(document.activeElement.getAttribute('aria-label') ?? "
        "document.activeElement.textContent).trim()"
    )
    reached = []

    def tab_to(name):
        while name not in (now := page.evaluate(focus)):
            reached.append(now)
            assert len(reached) < 40, reached
            page.keyboard.press("Tab")

    # the pressed button is hidden, so the focus is on the new photo
    assert "window.png" in page.evaluate(focus)
    page.evaluate("document.activeElement.blur()")
    tab_to("the photo on the left")
    page.keyboard.press("+")
    page.keyboard.press("ArrowRight")
    assert "zoomed" in page.locator("glass-compare").get_attribute("class")
    page.keyboard.press("0")
    tab_to("Line between")
    page.keyboard.press("PageUp")
    page.keyboard.press("ArrowLeft")
    assert share(page) == 59
    tab_to("Remove window.png")
    page.keyboard.press("Tab")
    page.keyboard.press("ArrowRight")  # the next view
    assert page.get_by_label("Reflection", exact=True).is_checked()
    page.keyboard.press("Tab")
    for _ in range(50):
        page.keyboard.press("ArrowLeft")
    assert page.locator("#amount").inner_text() == "50 %"
    tab_to("Download reflection")
    _, made = downloaded(page, lambda: page.keyboard.press("Enter"))
    assert made == run("-", "--strength", "0.5", "--layers", "reflection", stdin=data)[1]


def test_a_phone_shows_everything_without_horizontal_scrolling(open_page):
    page = open_page(viewport={"width": 390, "height": 844}, has_touch=True)
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    long = "a very long name of a photo taken through a window " * 3
    upload(
        page,
        *((f"{number} {long}.png", image_bytes(300, 200, "png", number)) for number in range(4)),
    )
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    assert page.locator("#download").bounding_box()["y"] + 44 <= 844
    for tool in ("move", "protect"):
        page.locator(f"input[name=tool][value={tool}]").check()
        for control in page.locator("button:visible, select:visible, input:visible").all():
            box = control.bounding_box()
            if control.get_attribute("type") == "checkbox":  # its label is the target
                box = control.locator("..").bounding_box()
            assert min(box["height"], box["width"]) >= 43.5, control.evaluate(
                "one => one.outerHTML"
            )
    page.locator("input[name=tool][value=move]").check()
    page.evaluate("scrollTo(0, 0)")
    before = share(page)
    stage = page.locator("glass-compare").bounding_box()
    finger = page.context.new_cdp_session(page)
    for kind, at in (
        ("touchStart", 0.5),
        ("touchMove", 0.6),
        ("touchMove", 0.8),
        ("touchEnd", None),
    ):
        points = (
            [] if at is None else [{"x": stage["x"] + at * stage["width"], "y": stage["y"] + 50}]
        )
        finger.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
    assert share(page) > before + 20


def test_the_confidence_is_shown_as_colours_over_the_grey_photo_with_a_legend(open_page):
    page = open_page()
    upload(page, ("window.png", image_bytes(90, 60, "png")))
    assert not page.locator("#legend").is_visible()
    page.get_by_label("Confidence", exact=True).check()
    settle(page)
    assert page.locator("#legend").inner_text().split() == ["certain", "uncertain"]
    shown = canvas(page, "right")
    # the pane is certain everywhere, so the photo is grey
    assert np.ptp(shown.astype(int), axis=2).max() <= 2
    colours = page.evaluate("""async () => {
        const { Layers, draw } = await import("/page/light.js");
        const map = { width: 3, height: 1, channels: 1, values: Float32Array.of(1, 0.5, 0) };
        const photo = new Uint8Array(9).fill(128);
        const preview = { full: [3, 1], width: 3, height: 1, photo, maps: { confidence: map } };
        const canvas = document.createElement("canvas");
        draw(canvas, Layers.ofPreview(preview), "confidence", 1);
        return Array.from(canvas.getContext("2d").getImageData(0, 0, 3, 1).data);
    }""")
    certain, middle, unknown = np.reshape(colours, (3, 4))[:, :3].astype(int)
    assert list(certain) == [128, 128, 128]
    assert np.ptp(middle) > 60
    assert np.ptp(unknown) > 60
    assert middle @ [2, 7, 1] > unknown @ [2, 7, 1] + 100  # the order is visible without colours


def test_a_file_that_is_not_a_photo_shows_an_error_and_can_be_retried_or_removed(open_page):
    page = open_page()
    upload(page, ("holiday.jpg", b"not a picture"), ("window.png", image_bytes(90, 60, "png")))
    assert page.get_by_role("heading", name="holiday.jpg could not be separated").is_visible()
    alert = page.get_by_role("alert")
    assert "not a photo, or it is damaged" in alert.inner_text()
    assert "no known image format" not in alert.inner_text()
    page.get_by_text("Message of the server").click()
    assert "no known image format" in alert.inner_text()
    assert page.get_by_role("button", name="Download transmission").is_disabled()
    assert page.get_by_role("button", name="Download all").is_enabled()
    page.get_by_role("button", name="Try again").click()
    page.wait_for_selector("#error:not([hidden])")
    page.get_by_role("button", name="Remove", exact=True).click()
    page.wait_for_selector("glass-compare:not([hidden])")
    assert page.get_by_role("listitem").count() == 1
    page.get_by_role("button", name="Remove window.png").click()
    assert page.evaluate("document.activeElement.id") == "undo-remove"


def test_many_photos_are_downloaded_as_one_zip_with_unique_names(open_page, run):
    photos = [
        ("a.png", image_bytes(90, 60, "png", 1)), ("a.png", image_bytes(90, 60, "png", 2)),
        ("ä.jpg", image_bytes(60, 50)),
    ]  # fmt: skip
    page = open_page()
    upload(page, *photos)
    name, data = downloaded(page, page.get_by_role("button", name="Download all").click)
    assert name == "brewster.zip"
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        assert archive.testzip() is None
        made = {name: archive.read(name) for name in archive.namelist()}
    names = [("a", "png"), ("2-a", "png"), ("ä", "jpg")]
    layers = [
        f"{name}.{layer}.{kind}" for name, kind in names for layer in ("transmission", "reflection")
    ]
    assert list(made) == [*layers, "brewster-report.txt"]
    for (_, photo), name in zip(photos, layers[::2], strict=True):
        assert made[name] == run("-", stdin=photo)[1]


def test_photos_can_be_pasted_and_dropped(open_page):
    page = open_page()
    send_event = """([kind, bytes]) => {
        const transfer = new DataTransfer();
        transfer.items.add(new File([new Uint8Array(bytes)], `${kind}.png`, { type: "image/png" }));
        const event = kind === "paste"
            ? new ClipboardEvent(kind, { clipboardData: transfer, bubbles: true })
            : new DragEvent(kind, { dataTransfer: transfer, bubbles: true, cancelable: true });
        document.body.dispatchEvent(event);
    }"""
    for kind in ("paste", "drop"):
        page.evaluate(send_event, [kind, list(image_bytes(60, 40, "png"))])
        page.get_by_role("button", name=f"{kind}.png").first.wait_for()
    page.wait_for_selector("li.done >> nth=1")
    assert "2 of 2 are done" in page.locator("#announcement").inner_text()


def test_a_photo_that_fails_is_left_out_of_the_zip_and_its_error_is_shown(open_page):
    page = open_page()
    photos = ((f"{name}.png", image_bytes(90, 60, "png", seed)) for seed, name in enumerate("abc"))
    upload(page, *photos, ("none.png", b"no photo"))
    assert page.locator("#summary").inner_text() == "4 photos: 3 partly removed, 1 failed"

    separated = []

    def refuse(route):
        separated.append(route)
        if len(separated) in (2, 4):  # b.png, in the zip and alone
            route.fulfill(status=422, json={"error": "its layers cannot be written"})
        else:
            route.continue_()

    page.route("**/separate?*", refuse)
    _, data = downloaded(page, page.get_by_role("button", name="Download all").click)
    archive = zipfile.ZipFile(io.BytesIO(data))
    *names, report = archive.namelist()
    assert [name[0] for name in names] == ["a", "a", "c", "c"]
    text = archive.read(report).decode()
    assert "2 done, 2 failed" in text
    assert "b.png: failed. Its layers cannot be written." in text
    assert (
        "2 of 4 photos are in the zip. b.png is not" in page.locator("#export-error").inner_text()
    )
    page.locator(".pick").nth(1).click()
    page.get_by_role("button", name="Download transmission").click()
    page.get_by_text("Its layers cannot be written.", exact=True).wait_for()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_has_contrast_in_light_and_dark_and_every_control_has_a_name(open_page, scheme):
    page = open_page(color_scheme=scheme, reduced_motion="reduce")
    upload(page, ("a.png", image_bytes(90, 60, "png")), ("b.png", b"none"))
    contrast = page.evaluate("""() => {
        const canvas = document.createElement("canvas")
            .getContext("2d", { willReadFrequently: true });
        const light = (colours) => {
            for (const colour of colours) {
                canvas.fillStyle = colour;
                canvas.fillRect(0, 0, 1, 1);
            }
            const part = [...canvas.getImageData(0, 0, 1, 1).data].map((code) => code / 255)
                .map((code) => (code <= 0.04045 ? code / 12.92 : ((code + 0.055) / 1.055) ** 2.4));
            return 0.2126 * part[0] + 0.7152 * part[1] + 0.0722 * part[2];
        };
        const behind = (element) => element
            ? [...behind(element.parentElement), getComputedStyle(element).backgroundColor] : [];
        return [...document.querySelectorAll("h1, p, label, legend, span, button, output, select")]
            .filter((element) => element.checkVisibility() && element.textContent.trim()
                && !element.disabled && !element.closest("glass-compare"))
            .map((element) => {
                const back = behind(element), front = [...back, getComputedStyle(element).color];
                const [one, other] = [light(back), light(front)].sort((a, b) => b - a);
                return [element.textContent.trim(), (one + 0.05) / (other + 0.05)];
            });
    }""")
    assert len(contrast) > 15
    assert [row for row in contrast if row[1] < 4.5] == []
    nameless = page.evaluate("""() => [
        ...document.querySelectorAll("button, input, select, [tabindex]")
    ]
        .filter((one) => one.checkVisibility()
            && !(one.getAttribute("aria-label") || one.textContent.trim() || one.labels?.length))
        .map((one) => one.outerHTML)""")
    assert nameless == []


def test_the_zip_waits_for_photos_that_are_not_separated_yet(open_page):
    page = open_page()
    held = []
    is_open = []
    page.route("**/preview?*", lambda route: route.continue_() if is_open else held.append(route))
    pictures = [
        (f"{name}.png", image_bytes(90, height, "png")) for height, name in enumerate("abc", 60)
    ]
    files = [{"name": name, "mimeType": "", "buffer": data} for name, data in pictures]
    page.set_input_files("#files", files)
    page.get_by_role("button", name="Download all").click()
    page.get_by_text("Waiting for 3 of 3 photos").wait_for()
    is_open.append(True)
    _, data = downloaded(page, lambda: [route.continue_() for route in held])
    names = zipfile.ZipFile(io.BytesIO(data)).namelist()
    assert [name[0] for name in names] == [*"aabbcc", "b"]
    assert page.locator("#export-error").is_hidden()


def test_photos_that_failed_while_the_server_was_away_are_retried_together(open_page):
    page = open_page()
    page.route("**/preview?*", lambda route: route.abort())
    photos = [(f"{name}.png", image_bytes(90, 60, "png", seed)) for seed, name in enumerate("ab")]
    upload(page, *photos, ("none.png", b"no photo"))
    page.unroute("**/preview?*")
    page.get_by_role("button", name="Retry all").click()
    page.wait_for_selector("li.done >> nth=1")
    assert not page.get_by_role("button", name="Retry all").is_visible()


STATES = """
    const current = (values) => ({ file: new File([], "a.png"), edits: { strength: 0.5, now: {} },
        progress: null, error: null, ...values });
    const result = { assessment: { verdict: "removed" }, note: null, next_step: null, burst: null };
    const progress = { phase: "working", share: 0.4, secondsLeft: 7, layers: "page/icon.svg" };
    const states = [
        current({ state: "waiting", isHeld: true }),
        current({ state: "working", progress }),
        current({ state: "failed" }),
        current({ state: "failed", error: { message: "No.", details: "None.", isFinal: true } }),
        current({ state: "done", size: [4, 3], result }),
        current({ state: "waiting", isUpdating: true, progress, size: [4, 3], result }),
    ].map((photo) => ({ photos: [photo], current: photo, isReady: photo.size !== undefined,
        layer: "confidence", retriableCount: 0, note: "", isNoteShown: false, zipLayers: [] }));
"""


def test_what_the_page_shows_depends_on_its_state_and_not_on_what_it_showed_before(open_page):
    shown = open_page().evaluate(f"""async () => {{
        const {{ render }} = await import("/page/views.js");
        {STATES}
        const show = (state) => (render(state), document.querySelector("main").innerText);
        return states.map((state) => states.map((before) => (show(before), show(state))));
    }}""")
    assert [len(set(pages)) for pages in shown] == [1] * len(shown)
    assert len({pages[0] for pages in shown}) == len(shown)

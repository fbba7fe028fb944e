"""The page never loses files or results, and reports what happens to them; in a real browser with a
real server.
"""

import pytest

from cli_helpers import image_bytes
from page_helpers import canvas, downloaded, names_in_list, settle, upload


def drop(page, *paths):
    """Drops files and folders of the disk on the page, as a file manager does."""
    session = page.context.new_cdp_session(page)
    data = {"items": [], "files": [str(path) for path in paths], "dragOperationsMask": 1}
    for kind in ("dragEnter", "dragOver", "drop"):
        session.send("Input.dispatchDragEvent", {"type": kind, "x": 300, "y": 300, "data": data})


@pytest.fixture
def folder(tmp_path):
    """A folder with three photos in two levels, and a text file."""
    for height, name in enumerate(("album/10.png", "album/9.png", "album/deep/1.png"), 40):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(image_bytes(60, height, "png"))
    (tmp_path / "album/notes.txt").write_text("no photo")
    return tmp_path / "album"


def test_a_dropped_folder_is_opened_and_its_other_files_are_counted(open_page, folder):
    page = open_page()
    drop(page, folder)
    page.wait_for_selector("li.done >> nth=2")
    assert names_in_list(page) == ["9.png", "10.png", "1.png"]
    assert (
        page.locator("#removed-text").inner_text()
        == "3 photos were added; 1 other file was left out."
    )


def test_a_folder_can_be_chosen(open_page, folder):
    page = open_page()
    page.set_input_files("#folder", str(folder))
    page.wait_for_selector("li.done >> nth=2")
    assert sorted(names_in_list(page)) == ["1.png", "10.png", "9.png"]


def test_a_folder_with_more_photos_than_the_list_can_contain_reports_how_many_are_left_out(
    open_page,
):
    """The entries of a folder are simulated: creating a hundred thousand files takes minutes."""
    page = open_page()
    found = page.evaluate("""async () => {
        const { readTransfer, describeAdded } = await import("/page/drop.js");
        let opened = 0;
        const entries = Array.from({ length: 100_000 }, (_, index) => ({
            name: `${index}.jpg`, isDirectory: false,
            file: (done) => (opened++, done(new File([], `${index}.jpg`))) }));
        const batches = [...Array(1000).keys()]
            .map((at) => entries.slice(100 * at, 100 * at + 100));
        const reader = { readEntries: (done) => done(batches.shift() ?? []) };
        const folder = { isDirectory: true, createReader: () => reader };
        const transfer = { items: [{ kind: "file", webkitGetAsEntry: () => folder }] };
        const found = await readTransfer(transfer, (name) => name.endsWith(".jpg"), 1000);
        return [found.files.length, found.surplus, opened, describeAdded(found)];
    }""")
    assert found[:3] == [1000, 99_000, 1000]
    assert "99000 more photos were left out" in found[3]


def test_a_removed_photo_comes_back_to_its_place_with_its_result_and_strength(open_page):
    page = open_page()
    upload(
        page,
        *((f"{name}.png", image_bytes(90, height, "png")) for height, name in enumerate("abc", 60)),
    )
    page.locator(".pick").nth(1).click()
    page.get_by_label("Strength", exact=True).fill("0.4")
    page.get_by_role("button", name="Remove b.png").click()
    assert names_in_list(page) == ["a.png", "c.png"]
    page.get_by_role("button", name="Undo removal").click()
    assert names_in_list(page) == ["a.png", "b.png", "c.png"]
    assert page.locator("li").nth(1).get_attribute("class") == "done"  # it is not separated again
    assert page.locator("#amount").inner_text() == "40 %"
    for _ in range(3):
        page.locator(".remove").first.click()
    assert page.get_by_role("heading", name="What is behind the glass?").is_visible()
    page.get_by_role("button", name="Undo removal").click()
    assert names_in_list(page) == ["c.png"]


@pytest.mark.parametrize(
    "device", [{}, {"viewport": {"width": 390, "height": 844}, "has_touch": True}]
)
def test_a_reload_keeps_photos_edits_and_settings_until_they_are_forgotten(open_page, device):
    page = open_page(**device)
    upload(
        page,
        *((f"{name}.png", image_bytes(90, height, "png")) for height, name in enumerate("abc", 60)),
    )
    page.locator(".pick").nth(1).click()
    page.get_by_label("Strength", exact=True).fill("0.4")
    page.locator("input[name=quality][value=draft]").check(force=True)
    page.wait_for_selector("li.done >> nth=2")
    page.get_by_role("button", name="Remove a.png").click()
    settle(page)
    shown = canvas(page, "right")
    page.route("**/preview?*", lambda route: route.abort())  # the results are kept, too
    page.reload()
    page.wait_for_selector("li.done >> nth=1")
    page.wait_for_selector("glass-compare:not([hidden])")
    settle(page)
    assert names_in_list(page) == ["b.png", "c.png"]
    assert (canvas(page, "right") == shown).all()
    assert page.locator("#amount").inner_text() == "40 %"
    assert page.locator("input[name=quality][value=draft]").is_checked()
    page.get_by_role("button", name="Undo", exact=True).click()
    assert page.locator("#amount").inner_text() == "100 %"
    page.once("dialog", lambda dialog: dialog.dismiss())
    page.get_by_role("button", name="Forget all").click()
    assert names_in_list(page) == ["b.png", "c.png"]
    page.once("dialog", lambda dialog: dialog.accept())
    page.get_by_role("button", name="Forget all").click()
    page.wait_for_selector("#welcome", state="visible")
    page.reload()
    settle(page)
    assert page.get_by_role("heading", name="What is behind the glass?").is_visible()
    assert names_in_list(page) == []


def test_the_focus_in_the_list_follows_the_photo_that_is_shown(open_page):
    page = open_page()
    for name in ("a.png", "b.png"):
        upload(page, (name, image_bytes(60, 40, "png", seed=ord(name[0]))))
        shown = page.locator("#photos .pick[aria-current]")
        assert shown.get_attribute("title") == name
        assert shown.evaluate("button => button === document.activeElement")


def test_a_reload_returns_to_the_photo_that_was_shown_last(open_page):
    page = open_page()
    upload(
        page,
        *((f"{name}.png", image_bytes(60, side, "png")) for side, name in enumerate("abc", 40)),
    )
    for name in ("c.png", "b.png"):
        page.locator(f".pick[title='{name}']").click()
        page.wait_for_selector("glass-compare:not([hidden])")
        page.reload()
        page.wait_for_selector("glass-compare:not([hidden])")
        assert page.locator(".pick[aria-current]").get_attribute("title") == name


def test_the_oldest_results_are_dropped_if_all_need_too_much_space(open_page):
    kept = open_page().evaluate("""async () => {
        const { keepPhoto, readSession } = await import("/page/session.js");
        for (const id of [1, 2, 3, 4]) {
            const made = { state: "done", preview: { size: 140e6 }, result: {} };
            const file = new File([], `${id}.png`);
            await keepPhoto({ id, file, edits: { history: 0 }, ...made });
        }
        return (await readSession()).photos.map(({ result }) => result !== undefined);
    }""")
    assert kept == [False, False, True, True]


def test_leaving_with_results_that_were_not_downloaded_asks_if_the_browser_keeps_nothing(open_page):
    page = open_page()
    page.add_init_script("Object.defineProperty(window, 'indexedDB', { value: undefined })")
    page.reload()
    page.wait_for_selector("#model option", state="attached")
    asked = []

    def answer(dialog):
        asked.append(dialog.type)
        dialog.dismiss() if len(asked) == 1 else dialog.accept()

    page.on("dialog", answer)
    upload(page, ("a.png", image_bytes(90, 60, "png")))
    page.get_by_label("Strength", exact=True).fill(
        "0.9"
    )  # the browser asks only after the page was used
    page.evaluate("location.reload()")
    page.wait_for_timeout(300)
    assert asked == ["beforeunload"]
    assert names_in_list(page) == ["a.png"]
    downloaded(page, page.get_by_role("button", name="Download transmission").click)
    page.wait_for_selector("#export", state="hidden")
    page.reload()
    assert asked == ["beforeunload"]
    assert names_in_list(page) == []


def test_a_file_that_was_deleted_after_it_was_added_is_named_as_the_cause(open_page, tmp_path):
    page = open_page()
    path = tmp_path / "a.png"
    path.write_bytes(image_bytes(90, 60, "png"))
    page.route("**/photos", lambda route: None)  # so that the file is still needed later
    page.set_input_files("#files", str(path))
    page.get_by_role("button", name="Cancel").click()
    path.unlink()
    page.unroute("**/photos")
    page.get_by_role("button", name="Try again").click()
    page.get_by_text("The photo was not sent. The file was moved, changed or deleted").wait_for()


def test_a_page_whose_link_has_become_invalid_says_so_and_not_what_a_program_should_send(open_page):
    page = open_page()
    page.context.clear_cookies()
    upload(page, ("a.png", image_bytes(90, 60, "png")))
    text = page.locator("#error-text").inner_text()
    assert "link" in text
    assert "Bearer" not in page.locator("#error").inner_text()
    assert page.get_by_role("button", name="Try again").is_visible()

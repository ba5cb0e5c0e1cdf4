"""scripts/pictures/screenshots.py: what it draws belongs to a page, loads nothing, and is small enough to be kept."""

from pathlib import Path

from PIL import Image

from scripts.docs import check_site, command_pages
from scripts.pictures import screenshots

ROOT = Path(__file__).resolve().parents[3]


def test_every_picture_has_a_page_that_shows_it() -> None:
    """Assert that each picture is of a command, is there, is small, and stands on the command's page."""
    commands = command_pages.every_command()
    for shot in screenshots.SHOTS:
        name = next(name for name in commands if shot.command.startswith(f"evetac {name} "))
        assert shot.name == name.replace(" ", "-")
        path = ROOT / "docs" / "pictures" / f"{shot.name}.webp"
        assert path.stat().st_size <= screenshots.MOST_BYTES
        with Image.open(path) as image:
            assert image.format == "WEBP"
        assert f"(../../pictures/{path.name})" in command_pages.pages()[f"commands/{shot.name}.md"]
    kept = {path.stem for path in (ROOT / "docs" / "pictures").glob("*.webp")}
    assert kept == {shot.name for shot in screenshots.SHOTS}


def test_a_terminal_is_drawn_without_outside_addresses(tmp_path: Path) -> None:
    """Assert that command and output are on the page, coloured, and that it names no font of elsewhere."""
    page, (width, height) = screenshots.terminal_page("evetac info a", "plain \x1b[31mred\x1b[0m", tmp_path)
    text = page.read_text()
    assert "evetac&#160;info&#160;a" in text
    assert "red" in text and "fill: #cc555a" in text
    assert [address for address in check_site.read(page).loads if check_site.is_external(address)] == []
    assert width > height > 0

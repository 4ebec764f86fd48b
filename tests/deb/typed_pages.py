"""The pages whose lines that begin with "$ " a test types; tests/deb/test_readme.py types most."""

FROM_NOTHING = ("README.md", "docs/first-steps.md", "docs/robot-arm.md")
WITH_ROBOT = tuple(
    f"docs/{name}.md"
    for name in (
        *("run-at-boot", "logs", "sandbox", "releases", "monitoring", "production"),
        "coming-from",
    )
)
"""Pages about a robot that is already in /srv/robot."""
ELSEWHERE = {
    "README.zh-CN.md": "tests/unit/project/test_pages.py",  # the same as README.md
    "docs/install.md": "tests/platforms/test_uv.py",
    "docs/on-failure.md": "tests/system/test_on_failure_page.py",
}

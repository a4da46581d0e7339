import brainbench


def test_version_is_the_package_version(run):
    assert run("--version").out.strip() == brainbench.__version__

import pytest

from tests.factories.published_files import PublishedReference


@pytest.fixture(scope="session")
def published(reference):
    return PublishedReference(reference / "published")

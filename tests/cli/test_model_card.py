def test_a_card_says_what_the_weights_are(run):
    def shown(name):
        return " ".join(run("models", "show", name).out.split())

    assert "weights trained: simclr" in shown("zhuang-small.simclr")
    assert "weights untrained" in shown("zhuang-small")
    assert "brainbench train zhuang-gru --objective simclr" in shown("zhuang-gru.simclr")

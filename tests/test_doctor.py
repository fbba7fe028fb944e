from brewster.cli import doctor


def of_large(monkeypatch, versions):
    monkeypatch.setattr(doctor, "_version", versions.get)
    return {check.name: check for check in doctor._large()}


def test_what_large_models_may_want_is_told_where_they_are_installed(monkeypatch, tmp_path):
    monkeypatch.setenv("HF_HOME", str(tmp_path))
    monkeypatch.delenv("HF_TOKEN", raising=False)
    assert of_large(monkeypatch, {}) == {}
    missing = of_large(monkeypatch, {"diffusers": "1"})
    assert [check.cure for check in missing.values()] == ["pip install bitsandbytes", "hf auth login"]
    assert not any(check.needed for check in missing.values())


def test_a_token_is_found_in_the_environment_or_where_the_hub_client_keeps_it_and_never_shown(
    monkeypatch, tmp_path
):
    monkeypatch.setenv("HF_HOME", str(tmp_path))
    (tmp_path / "token").write_text("hf_secret")
    monkeypatch.delenv("HF_TOKEN", raising=False)
    kept = of_large(monkeypatch, {"diffusers": "1", "bitsandbytes": "2"})
    assert {check.status for check in kept.values()} == {"ok"}
    assert kept["hub token"].detail == f"from {tmp_path / 'token'}"
    monkeypatch.setenv("HF_TOKEN", "hf_secret")
    told = of_large(monkeypatch, {"diffusers": "1"})["hub token"]
    assert (told.status, told.detail) == ("ok", "from HF_TOKEN")

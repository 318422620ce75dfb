from ljn.tasks.listing import CONF, GROUPS, descriptions, list_choices


def test_every_experiment_sweep_and_preset_says_what_it_is():
    for group in GROUPS:
        lines = descriptions(CONF / group)
        assert lines
        for name, line in lines.items():
            assert (CONF / group / f"{name}.yaml").is_file()
            assert len(line) > 10, f"{group}/{name}.yaml has no comment that says what it is"
            assert "run.py" not in line
            assert "@package" not in line


def test_a_line_is_the_first_sentence_after_package_and_command(tmp_path):
    (tmp_path / "group").mkdir()
    (tmp_path / "group" / "a.yaml").write_text(
        "# @package _global_\n# python run.py experiment=a\n# What it is,\n# in 3.5 words.\n# More.\nname: a\n"
    )
    (tmp_path / "b.yaml").write_text("name: b # not the head\n# no\n")
    assert descriptions(tmp_path) == {"b": "", "group/a": "What it is, in 3.5 words."}


def test_the_list_has_a_line_for_each(capsys):
    assert list_choices() == {}
    printed = capsys.readouterr().out.splitlines()
    assert len(printed) == sum(1 + len(descriptions(CONF / group)) for group in GROUPS)
    [line] = [line for line in printed if line.startswith("  detector/basic ")]
    assert line.split(maxsplit=1)[1].startswith("The basic joint detector.")

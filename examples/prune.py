"""Search for a learning rate with optuna, and stop runs early that fall behind.

    python examples/prune.py

It needs optuna: `pip install optuna`. The places are rendered; a trial is a run of `cj.fit`.
"""

import dataclasses
import pathlib
import tempfile

import crisalad_jax as cj

TRIALS, EPOCHS = 3, 4


class Prune(cj.Callback):
    """Reports each validation to an optuna trial, and stops the run if it should be pruned."""

    def __init__(self, trial):
        """Store the trial."""
        self.trial, self.recall = trial, 0.0

    def on_validation(self, numbers):
        """Report R@1."""
        self.recall = numbers["R@1"]
        self.trial.report(self.recall, step=numbers["epoch"])
        if self.trial.should_prune():
            raise cj.StopTraining


def main():
    """Train a small model a few times with different learning rates."""
    try:
        import optuna
    except ModuleNotFoundError:
        print("optuna is not installed: pip install optuna")
        return None
    folder = pathlib.Path(tempfile.mkdtemp())
    sizes = cj.synthetic.SyntheticCityConfig(train_places=24, test_places=12, image_size=(70, 70))
    cj.synthetic.write_synthetic_city(folder / "city", sizes, quiet=True)
    places = cj.read_places(folder / "city" / "train")
    validation = cj.open_benchmark(folder / "city" / "test")
    config = cj.recipe("tiny")
    backbone = dataclasses.replace(config.model.backbone, dim=32, depth=1, heads=2)
    model = dataclasses.replace(config.model, image_size=(70, 70), backbone=backbone)
    config = dataclasses.replace(
        config,
        model=model,
        places_per_batch=8,
        images_per_place=2,
        epochs=EPOCHS,
        validate_every=1,
    )

    def objective(trial):
        rate = trial.suggest_float("learning_rate", 1e-5, 1e-2, log=True)
        optimiser = dataclasses.replace(config.optimiser, learning_rate=rate, warmup_steps=2)
        prune = Prune(trial)
        result = cj.fit(
            dataclasses.replace(config, optimiser=optimiser),
            places,
            folder / f"trial-{trial.number}",
            validation=validation,
            callbacks=[prune, "csv"],
            quiet=True,
        )
        if result.stopped_early:
            raise optuna.TrialPruned
        return prune.recall

    pruner = optuna.pruners.MedianPruner(n_startup_trials=1)
    sampler = optuna.samplers.TPESampler(seed=0)
    study = optuna.create_study(direction="maximize", pruner=pruner, sampler=sampler)
    study.optimize(objective, n_trials=TRIALS)
    for trial in study.trials:
        print(f"trial {trial.number}: {trial.params} {trial.state.name} {trial.value}")
    return study


if __name__ == "__main__":
    main()

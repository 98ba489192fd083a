"""Search for a learning rate with Ray Tune: parallel trials on a machine or a cluster.

    python examples/sweep.py

It needs Ray Tune: `pip install 'ray[tune]'`. The places are rendered; a trial is a run of `cj.fit`.
"""

import dataclasses
import pathlib
import tempfile

import crisalad_jax as cj

RATES, EPOCHS = (1e-2, 1e-3, 1e-5), 4


def report_to_tune():
    """Make a callback that reports each validation to Ray Tune, which may then end the trial."""
    from ray import tune

    class Report(cj.Callback):
        def on_validation(self, numbers):
            tune.report({"recall": numbers["R@1"], "epoch": numbers["epoch"]})

    return Report()


def train(trial, city, runs):
    """Train a small model as one trial; a restarted trial resumes its run."""
    from ray import tune

    config = cj.recipe("tiny")
    backbone = dataclasses.replace(config.model.backbone, dim=32, depth=1, heads=2)
    model = dataclasses.replace(config.model, image_size=(70, 70), backbone=backbone)
    rate = trial["learning_rate"]
    config = dataclasses.replace(
        config,
        model=model,
        optimiser=dataclasses.replace(config.optimiser, learning_rate=rate, warmup_steps=2),
        places_per_batch=8,
        images_per_place=2,
        epochs=EPOCHS,
        validate_every=1,
    )
    cj.fit(
        config,
        cj.read_places(city / "train"),
        runs / tune.get_context().get_trial_id(),
        validation=cj.open_benchmark(city / "test"),
        callbacks=["csv", report_to_tune()],  # Tune may end the trial in the second callback
        quiet=True,
    )


def main(folder=None):
    """Try the learning rates, two trials at a time, and return Tune's results."""
    try:
        from ray import tune
    except ImportError:
        print("Ray Tune is not installed: pip install 'ray[tune]'")
        return None
    folder = pathlib.Path(folder or tempfile.mkdtemp())
    sizes = cj.synthetic.SyntheticCityConfig(train_places=24, test_places=12, image_size=(70, 70))
    cj.synthetic.write_synthetic_city(folder / "city", sizes, quiet=True)
    # On GPUs: tune.with_resources(trial, {"gpu": 1}).
    trial = tune.with_parameters(train, city=folder / "city", runs=folder / "runs")
    results = tune.Tuner(
        trial,
        param_space={"learning_rate": tune.grid_search(RATES)},
        tune_config=tune.TuneConfig(
            metric="recall",
            mode="max",
            max_concurrent_trials=2,
            scheduler=tune.schedulers.ASHAScheduler("epoch", max_t=EPOCHS, grace_period=1),
        ),
        # A trial whose worker is lost is restarted.
        run_config=tune.RunConfig(
            storage_path=str(folder / "tune"),
            failure_config=tune.FailureConfig(max_failures=2),
        ),
    ).fit()
    for result in results:
        rate, numbers = result.config["learning_rate"], result.metrics
        print(f"{rate:g}: R@1 {numbers['recall']:.3f} after epoch {numbers['epoch']}")
    return results


if __name__ == "__main__":
    main()

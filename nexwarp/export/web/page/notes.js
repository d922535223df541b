// Annotations: numbered dots with labels at points of the scene.

export class Notes {
    // `act` is called with the point of a note that a person chooses.
    constructor(entries, list, act) {
        this.notes = entries.map(({point, text}, index) => {
            const button = document.createElement("button"), number = document.createElement("b");
            const label = document.createElement("span");
            number.textContent = String(index + 1);
            label.textContent = text;
            button.type = "button";
            button.append(number, label);
            button.onclick = () => act(point);
            list.append(button);
            return {point, button};
        });
    }

    // Move the notes to where a camera shows their points.
    place({viewmat: m, K: [fx, fy, cx, cy], width, height, near}) {
        for (const {point: [x, y, z], button} of this.notes) {
            const [right, down, ahead] = [0, 4, 8].map(i => m[i] * x + m[i + 1] * y + m[i + 2] * z + m[i + 3]);
            const left = ((fx * right) / ahead + cx) / width, top = ((fy * down) / ahead + cy) / height;
            button.hidden = !(ahead > near && Math.abs(left - 0.5) < 0.5 && Math.abs(top - 0.5) < 0.5);
            button.classList.toggle("leftward", left > 0.6);
            Object.assign(button.style, {left: `${100 * left}%`, top: `${100 * top}%`});
        }
    }
}
